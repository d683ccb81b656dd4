"""A body: patches of skin, from a body file or equal ones, and the nodes that serve them.

A launch file has a table [skin]: either `body`, the name of a body file, or `patches`, a number of
equal patches. Patches with the same skin, compressor settings and host form a batch. Each node
that can serve several patches, and states none, is made once for each batch.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from sparseskin.messages.fields import MAX_ELEMENTS
from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.messages.topics import MAX_NAMES, MAX_PATCHES
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.monitor.node import check_pose
from sparseskin.nodes.numerics.arrays import mask_texts
from sparseskin.nodes.sensor.calibration.description import SkinDescription
from sparseskin.nodes.sensor.scenes.address import PITCH_MM
from sparseskin.nodes.sensor.skin_file import MAX_FILE_CHARS, load_skin, parse_skin
from sparseskin.nodes.settings import Settings, setting
from sparseskin.nodes.toml import parse_toml

from .tables import Fault, Place, Table, bad_name, read_table

SKIN = "skin"
"""Name of the table."""
MAX_BODY = 4096
"""Most patches of a body; chosen."""
BODY_KEYS = ("patches", "description")
"""Keys of a body file."""
_OF_SKIN = (
    "n_rows",
    "n_cols",
    "points",
    "pitch_mm",
    "f_max",
    "unit",
    "mask",
    "noise",
    "noise_mid",
)


@dataclass(frozen=True)
class SkinTable(Settings):
    """The table [skin]: `body`, or `patches` equal ones."""

    body: str = setting("", "name of a body file, in place of patches")
    patches: int | None = setting(None, "number of equal patches", low=1, high=MAX_BODY)
    n_rows: int = setting(64, "rows of taxels of a patch")
    n_cols: int = setting(64, "columns of taxels of a patch")
    pitch_mm: float = setting(PITCH_MM, "distance of neighbouring taxels, mm")
    f_max: float = setting(PAPER_F_MAX_N, "upper end of the range of a taxel, N")
    batch: int = setting(
        MAX_PATCHES, "most patches of one batch", low=1, high=MAX_PATCHES
    )


@dataclass(frozen=True)
class PatchTable(Settings):
    """A table [[patches]] of a body file, beside the keys of its skin."""

    name: str = setting("", "the patch in topics, on the page and in summaries")
    skin: str = setting("", "name of its skin.toml, in place of keys of the skin")
    host: str = setting("", "host of its nodes; by default as they state")
    compressor: Table | None = setting(None, "settings of its compressor")
    pose: tuple[float, ...] | None = setting(
        None, "x, y, z of its middle in mm, roll, pitch, yaw in degrees"
    )


@dataclass(frozen=True, eq=False)
class Patch:
    """One patch of a body: its name, its skin, the host of its nodes, the settings of its
    compressor that are in place of the node's, and its pose.
    """

    name: str
    skin: SkinDescription
    host: str = ""
    compressor: Mapping[str, Any] = field(default_factory=dict)
    pose: tuple[float, ...] | None = None

    @property
    def kind(self) -> str:
        """What the patches of a batch share."""
        # Tables are compared by their texts: lists in them cannot be keys.
        compressor = sorted(self.compressor.items())
        return repr((self.simulated, self.host, compressor))

    @property
    def simulated(self) -> Table:
        """The setting `simulated` of a sensor node for such patches."""
        s = self.skin
        # What is None is left to the defaults of the sensor.
        values: Table = {
            "f_max": s.f_max,
            "noise": s.noise,
            "noise_mid": s.noise_mid,
        }
        if s.placement is not None:
            values["points"] = s.placement.layout
        else:
            values |= {"n_rows": s.n_rows, "n_cols": s.n_cols}
            values["pitch_mm"] = s.pitch_mm or PITCH_MM
            if s.mask is not None and not s.mask.all():
                values["mask"] = mask_texts(s.mask)
        return {key: value for key, value in values.items() if value is not None}


@dataclass(frozen=True)
class Batch:
    """Patches served together: equal skins, settings and host."""

    name: str
    patches: tuple[Patch, ...]

    @property
    def names(self) -> list[str]:
        return [patch.name for patch in self.patches]


def read_skin(table: object, folder: Path, fault: Fault) -> list[Batch]:
    """Check the table [skin] of a launch file and the body file that it names, which is searched
    in `folder`; none if there is an error, each of which is noted.
    """
    n_faults = 0
    patches: list[Patch] = []

    def note(place: Place, problem: str) -> None:
        nonlocal n_faults
        n_faults += 1
        fault(place, problem)

    (stated,), _ = read_table(table, (SKIN,), note, SkinTable())
    if stated.body:
        note_of_body = partial(note, (SKIN, "body"))
        patches = read_body(folder / stated.body, note_of_body)
    elif stated.patches is not None:
        try:
            skin = SkinDescription(
                name=SKIN,
                n_rows=stated.n_rows,
                n_cols=stated.n_cols,
                pitch_mm=stated.pitch_mm,
                f_max=stated.f_max,
            )
            # Equal widths, so that the order of names is that of numbers.
            width = len(str(stated.patches - 1))
            for k in range(stated.patches):
                patches.append(Patch(f"p{k:0{width}d}", skin))
        except SparseskinError as error:
            key, _, problem = str(error).partition(": ")
            note((SKIN, key), problem)
    elif not n_faults:
        note((SKIN, "patches"), f"is missing, and body too; allowed: 1..{MAX_BODY}")
    if n_faults:
        return []
    return list(batches_of(patches, stated.batch))


def read_body(path: Path, fault: Callable[[str], None]) -> list[Patch]:
    """Read a body file and check it whole; `fault` receives each error as one line that begins with
    the file and the place in it.

    It is a TOML file of tables [[patches]]: name, and either the keys of a skin.toml (n_rows and
    n_cols are required, f_max is by default 2.5, pitch_mm 5) or skin = "FILE.toml"; host, and
    compressor, a table of settings.
    """
    try:
        with path.open(encoding="utf-8") as file:
            # One more than allowed: that it is too long is seen then.
            text = file.read(MAX_FILE_CHARS + 1)
        tree = parse_toml(text, MAX_FILE_CHARS)
    except OSError as error:
        fault(f"{path}: cannot be read ({error.strerror})")
        return []
    except ValueError as error:
        fault(f"{path}: cannot be read ({' '.join(str(error).split())})")
        return []

    for key in tree:
        if key not in BODY_KEYS:
            hint = did_you_mean(key, BODY_KEYS)
            fault(f"{path}: {key[:40]}: unknown key{hint}")
    tables = tree.get("patches")
    if not isinstance(tables, list):
        tables = []
    if not 1 <= len(tables) <= MAX_BODY:
        fault(f"{path}: patches: expected 1..{MAX_BODY} tables [[patches]]")
        return []

    # A faulty patch is left out, so that all faults are found at once.
    patches: dict[str, Patch] = {}
    for k, table in enumerate(tables):
        where = f"{path}: patches[{k}]"
        try:
            patch = _patch(table, where, path.parent)
            if patch.name in patches:
                raise SparseskinError(f"{where}.name: '{patch.name}' occurs twice")
            patches[patch.name] = patch
        except SparseskinError as error:
            fault(str(error))
    return list(patches.values())


def _patch(table: object, where: str, folder: Path) -> Patch:
    """One table [[patches]]; SparseskinError with its place if it is not as stated."""
    if not isinstance(table, dict):
        raise SparseskinError(f"{where}: expected a table [[patches]]")
    patch_keys = [table_field.name for table_field in dataclasses.fields(PatchTable)]
    allowed = (*patch_keys, *_OF_SKIN)
    for key in table:
        if key not in allowed:
            hint = did_you_mean(key, allowed)
            raise SparseskinError(f"{where}.{key[:40]}: unknown key{hint}")
    name: Any = table.get("name")
    why = bad_name(name)
    if why:
        raise SparseskinError(f"{where}.name: {why}")

    # From here on errors name the patch, too.
    where = f"{where} ({name})"
    skin_keys = {key: table[key] for key in _OF_SKIN if key in table}
    of_patch = {key: table[key] for key in patch_keys if key in table}
    try:
        stated = PatchTable(**of_patch)
    except SparseskinError as error:
        raise SparseskinError(f"{where}.{error}") from error
    skin = _skin(stated, skin_keys, where, folder)
    _check_compressor(stated, where)
    if stated.pose is not None:
        check_pose(f"{where}.pose", stated.pose)
    return Patch(name, skin, stated.host, stated.compressor or {}, stated.pose)


def _skin(
    stated: PatchTable, skin_keys: Table, where: str, folder: Path
) -> SkinDescription:
    """The skin of a patch, from its file or from the keys of its table."""
    if not stated.skin:
        # The taxels of a layout have places of their own.
        values: Table = {"name": stated.name, "f_max": PAPER_F_MAX_N}
        if "points" not in skin_keys:
            values["pitch_mm"] = PITCH_MM
        skin = parse_skin(values | skin_keys, where, folder)
    else:
        for key in skin_keys:
            raise SparseskinError(f"{where}.{key}: is stated beside skin")
        skin = load_skin(folder / stated.skin)
    if skin.unit != "N":
        raise SparseskinError(
            f"{where}.unit: '{skin.unit}'; allowed for a simulated body: N"
        )
    return skin


def _check_compressor(stated: PatchTable, where: str) -> None:
    compressor = stated.compressor or {}
    for key in ("patch", "patches"):
        if key in compressor:
            raise SparseskinError(f"{where}.compressor.{key}: is given by the body")
    # Checked as of a batch of two, which allows less than one patch does.
    patches = [stated.name, f"{stated.name}_"]
    values = {**compressor, "patches": patches}
    try:
        CompressorSettings.from_mapping(values).check()
    except SparseskinError as error:
        raise SparseskinError(f"{where}.compressor.{error}") from error


def batches_of(patches: list[Patch], most: int) -> Iterator[Batch]:
    """Batches of equal patches, at most `most` each, in the order of their first patches."""
    kinds: dict[str, list[Patch]] = {}
    for patch in patches:
        kinds.setdefault(patch.kind, []).append(patch)

    # A message holds all patches of a batch, and their names: both have a largest size.
    parts: list[list[Patch]] = []
    for alike in kinds.values():
        skin = alike[0].skin
        n_fitting = MAX_ELEMENTS // (skin.n_rows * skin.n_cols)
        room = max(1, min(most, n_fitting))
        part: list[Patch] = []
        length = 0
        for patch in alike:
            # Names are separated by one character each.
            length += len(patch.name) + 1
            if len(part) == room or length > MAX_NAMES:
                parts.append(part)
                part = []
                length = len(patch.name) + 1
            part.append(patch)
        parts.append(part)

    for k, part in enumerate(parts, start=1):
        name = "body"
        if len(parts) > 1:
            name += f"_{k}"
        yield Batch(name, tuple(part))


def expand(
    name: str, table: Mapping[str, Any], fields: set[str], batches: list[Batch]
) -> dict[str, Table]:
    """The tables of the nodes that serve a body, made of one table [nodes.NAME].

    `fields` are the names of the settings of its type. A node that serves single patches, or states
    its own, is left as it is, a monitor gets all batches.
    """
    if "batches" in fields:
        names = {}
        poses = {}
        for batch in batches:
            names[batch.name] = batch.names
            for patch in batch.patches:
                if patch.pose is not None:
                    poses[patch.name] = list(patch.pose)
        of_body = {
            "patches": [],
            "batches": names,
            "poses": poses,
        }
        return {name: {**of_body, **table}}

    keys = {"patch", "patches"}
    if not keys <= fields or keys & table.keys():
        return {name: dict(table)}

    tables = {}
    for k, batch in enumerate(batches, start=1):
        # All patches of a batch have these in common.
        patch = batch.patches[0]
        values: Table = {"patch": batch.name, "patches": batch.names}
        if "simulated" in fields:
            values["simulated"] = patch.simulated
        if "ratio" in fields:
            values |= patch.compressor
        if patch.host:
            values["host"] = patch.host
        node = name
        if len(batches) > 1:
            node += f"_{k}"
        tables[node] = {**table, **values}
    return tables
