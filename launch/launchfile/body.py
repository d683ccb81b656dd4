"""A body: patches of skin, from a body file or equal ones, and the nodes that serve them.

A launch file has a table [skin]: either `body`, the name of a body file, or `patches`, a number of
equal patches. Patches with the same skin, compressor settings and host form a batch. Each node
whose type ends in _batch is made once for each batch.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sparseskin.messages.batches import MAX_NAMES, MAX_PATCHES
from sparseskin.messages.errors import MessageError
from sparseskin.messages.ranges import is_real, is_whole
from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.messages.topics import check_name
from sparseskin.nodes.compressor.batch import CompressorBatchSettings
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.sensor.batch import MAX_TAXELS
from sparseskin.nodes.sensor.calibration.description import SkinDescription
from sparseskin.nodes.sensor.calibration.skin_file import MAX_FILE_CHARS, load_skin, parse_skin
from sparseskin.nodes.toml import parse_toml

SKIN = "skin"
"""Name of the table."""
MAX_BODY = 4096
"""Most patches of a body."""
PITCH_MM = 5.0
"""Distance of taxels where none is stated, in mm: that of the paper's skin."""
_SKIN_KEYS = ("body", "patches", "rows", "cols", "pitch_mm", "f_max", "batch")
_POSE_KEYS = ("position_mm", "orientation")
_OWN_KEYS = ("name", "skin", "host", "compressor", *_POSE_KEYS)
_OF_SKIN = ("rows", "cols", "points", "pitch_mm", "f_max", "unit", "mask", "noise", "noise_mid")
_UNIT_NORM = 1e-3
"""Allowed difference of the norm of an orientation from 1."""

Fault = Callable[[tuple[str, ...], str], None]


@dataclass(frozen=True, eq=False)
class Patch:
    """One patch of a body.

    Attributes
    ----------
    name : str
        The patch in topics, on the page and in summaries.
    skin : SkinDescription
        Its geometry, range and noise.
    position_mm : (x, y, z)
        Middle of the patch on the body, mm.
    orientation : (w, x, y, z)
        Unit quaternion that turns the patch's frame (columns, rows, outward normal) to the body's.
    host : str
        Host of its sensor, compressor and reconstructor; "": as their nodes state.
    compressor : dict
        Settings of its compressor, in place of the node's.
    """

    name: str
    skin: SkinDescription
    position_mm: tuple[float, ...] = (0.0, 0.0, 0.0)
    orientation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    host: str = ""
    compressor: Mapping[str, Any] = field(default_factory=dict)

    @property
    def kind(self) -> tuple[Any, ...]:
        """What the patches of a batch share."""
        s = self.skin
        mask = None if s.mask is None or s.mask.all() else s.mask.tobytes()
        settings = repr(sorted(self.compressor.items()))
        layout = None if s.placement is None else s.placement.layout
        of_skin = (*s.shape, s.pitch_mm, s.f_max, mask, s.noise, s.noise_mid, layout)
        return (*of_skin, self.host, settings)

    def sensor_values(self) -> dict[str, Any]:
        """Settings of a sensor node of a batch for such patches."""
        s = self.skin
        values: dict[str, Any] = {
            "n_rows": s.rows,
            "n_cols": s.cols,
            "pitch_mm": s.pitch_mm or PITCH_MM,
            "f_max": s.f_max,
        }
        if s.placement is not None:
            return {"points": s.placement.layout, "f_max": s.f_max, **self._noise_values()}
        if s.mask is not None and not s.mask.all():
            values["mask"] = ["".join("01"[cell] for cell in row) for row in s.mask.astype(int)]
        return values | self._noise_values()

    def _noise_values(self) -> dict[str, float]:
        stated = {"sigma_end": self.skin.noise, "sigma_mid": self.skin.noise_mid}
        return {key: value for key, value in stated.items() if value is not None}


@dataclass(frozen=True)
class Batch:
    """Patches served together: equal skins, settings and host."""

    name: str
    patches: tuple[Patch, ...]

    @property
    def names(self) -> list[str]:
        return [patch.name for patch in self.patches]


def read_skin(table: object, folder: Path, fault: Fault) -> list[Batch]:
    """Check the table [skin] of a launch file and the body file that it names.

    Parameters
    ----------
    table : object
        The table: `body`, or `patches` with rows, cols (64), pitch_mm (5) and f_max (2.5 N) of all;
        `batch` is the most patches of one batch.
    folder : path
        Folder in which a relative `body` is searched.
    fault : callable
        Receives the place and text of each error.

    Returns
    -------
    list of Batch
        None if there was an error.
    """
    if not isinstance(table, dict):
        fault((SKIN,), "expected a table [skin]")
        return []
    n_faults = 0

    def note(key: str, what: str) -> None:
        nonlocal n_faults
        n_faults += 1
        fault((SKIN, key) if key else (SKIN,), what)

    for key in table:
        if key not in _SKIN_KEYS:
            note(key, f"unknown key{did_you_mean(key, _SKIN_KEYS)}")
    most = table.get("batch", MAX_PATCHES)
    if not is_whole(most, 1, MAX_PATCHES):
        note("batch", f"expected a whole number in 1..{MAX_PATCHES}, got {most!r}")
    body = table.get("body", "")
    if body:
        if not isinstance(body, str):
            note("body", f"expected the name of a file, got {body!r}")
            return []
        patches = read_body(folder / body, lambda what: note("body", what))
    else:
        patches = _equal_patches(table, note)
    return [] if n_faults else list(batches_of(patches, int(most)))


def _equal_patches(table: Mapping[str, Any], note: Callable[[str, str], None]) -> list[Patch]:
    n = table.get("patches")
    if not is_whole(n, 1, MAX_BODY):
        shown = "is missing, and body too" if n is None else f"got {n!r}"
        note("patches", f"{shown}; expected a whole number in 1..{MAX_BODY}")
        return []
    values: dict[str, Any] = {"rows": 64, "cols": 64, "pitch_mm": PITCH_MM, "f_max": PAPER_F_MAX_N}
    values |= {key: table[key] for key in values if key in table}
    try:
        skin = SkinDescription(name=SKIN, **values)
    except SparseskinError as error:
        key, _, what = str(error).partition(": ")
        note(key if key in values else "", what)
        return []
    width = len(str(n - 1))
    return [Patch(f"p{k:0{width}d}", skin) for k in range(n)]


def read_body(path: Path, fault: Callable[[str], None]) -> list[Patch]:
    """Read a body file and check it whole.

    Parameters
    ----------
    path : path
        A TOML file of tables [[patches]]: name, and either the keys of a skin.toml (rows and cols
        are required, f_max is by default 2.5, pitch_mm 5) or skin = "FILE.toml"; position_mm
        [x, y, z], orientation [w, x, y, z], host, and compressor, a table of settings.
    fault : callable
        Receives each error as one line that begins with the file and the place in it.
    """
    try:
        with path.open(encoding="utf-8") as file:
            tree = parse_toml(file.read(MAX_FILE_CHARS + 1), MAX_FILE_CHARS)
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else " ".join(str(error).split())
        fault(f"{path}: cannot be read ({why})")
        return []
    for key in tree:
        if key not in ("patches", "description"):
            fault(f"{path}: {key[:40]}: unknown key{did_you_mean(key, ('patches', 'description'))}")
    tables = tree.get("patches")
    if not isinstance(tables, list) or not 1 <= len(tables) <= MAX_BODY:
        fault(f"{path}: patches: expected 1..{MAX_BODY} tables [[patches]]")
        return []
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
    known = (*_OWN_KEYS, *_OF_SKIN)
    for key in table:
        if key not in known:
            raise SparseskinError(f"{where}.{key[:40]}: unknown key{did_you_mean(key, known)}")
    try:
        name = check_name("name", table.get("name"))
    except MessageError as error:
        raise SparseskinError(f"{where}.{error}") from error
    where = f"{where} ({name})"
    own = {key: table[key] for key in _OF_SKIN if key in table}
    if "skin" in table:
        if own:
            raise SparseskinError(f"{where}.{next(iter(own))}: is stated beside skin")
        if not isinstance(table["skin"], str):
            raise SparseskinError(f"{where}.skin: expected the name of a file")
        skin = load_skin(folder / table["skin"])
    else:
        stated = {"name": name, "f_max": PAPER_F_MAX_N, **own}
        if "points" not in own:
            stated.setdefault("pitch_mm", PITCH_MM)
        skin = parse_skin(stated, where, folder)
    if skin.unit != "N":
        raise SparseskinError(f"{where}.unit: '{skin.unit}'; allowed for a simulated body: N")
    pose = {key: _numbers(table[key], key, where) for key in _POSE_KEYS if key in table}
    if "orientation" in pose and abs(math.hypot(*pose["orientation"]) - 1) > _UNIT_NORM:
        raise SparseskinError(f"{where}.orientation: expected [w, x, y, z] of norm 1")
    host, settings = table.get("host", ""), table.get("compressor", {})
    if not isinstance(host, str):
        raise SparseskinError(f"{where}.host: expected a name, got {host!r}")
    if not isinstance(settings, dict):
        raise SparseskinError(f"{where}.compressor: expected a table of settings")
    for key in ("patch", "patches"):
        if key in settings:
            raise SparseskinError(f"{where}.compressor.{key}: is given by the body")
    try:
        CompressorBatchSettings.from_mapping({**settings, "patches": [name]}).check()
    except SparseskinError as error:
        raise SparseskinError(f"{where}.compressor.{error}") from error
    return Patch(name, skin, host=host, compressor=settings, **pose)


def _numbers(value: object, key: str, where: str) -> tuple[float, ...]:
    """A list of finite numbers, 3 of a position and 4 of an orientation."""
    wanted = len(getattr(Patch, key))
    if not isinstance(value, list) or len(value) != wanted or not all(map(is_real, value)):
        raise SparseskinError(f"{where}.{key}: expected {wanted} finite numbers, got {value!r}")
    return tuple(map(float, value))


def batches_of(patches: list[Patch], most: int) -> Iterator[Batch]:
    """Batches of equal patches, at most `most` each, in the order of their first patches."""
    kinds: dict[tuple[Any, ...], list[Patch]] = {}
    for patch in patches:
        kinds.setdefault(patch.kind, []).append(patch)
    parts: list[list[Patch]] = []
    for alike in kinds.values():
        cells = alike[0].skin.rows * alike[0].skin.cols
        room = max(1, min(most, MAX_TAXELS // cells))
        part: list[Patch] = []
        for patch in alike:
            length = sum(len(each.name) + 1 for each in [*part, patch])
            if len(part) == room or length > MAX_NAMES:
                parts.append(part)
                part = []
            part.append(patch)
        parts.append(part)
    for k, part in enumerate(parts, start=1):
        yield Batch("body" if len(parts) == 1 else f"body_{k}", tuple(part))


def expand(
    name: str, table: Mapping[str, Any], fields: set[str], batches: list[Batch]
) -> dict[str, dict[str, Any]]:
    """The tables of the nodes that serve a body, made of one table [nodes.NAME].

    `fields` are the names of the settings of its type. A node that serves single patches and states
    no `patches` is left as it is, a monitor gets all batches.
    """
    if "batches" in fields:
        all_names = {batch.name: batch.names for batch in batches}
        return {name: {"patches": [], "batches": all_names, **table}}
    if not {"patch", "patches"} <= fields or "patches" in table:
        return {name: dict(table)}
    found = {}
    for k, batch in enumerate(batches, start=1):
        first = batch.patches[0]
        values: dict[str, Any] = {"patch": batch.name, "patches": batch.names}
        if "n_rows" in fields:
            values |= first.sensor_values()
        if "ratio" in fields:
            values |= first.compressor
        if first.host:
            values["host"] = first.host
        found[name if len(batches) == 1 else f"{name}_{k}"] = {**table, **values}
    return found


def settings_names(cls: Any) -> set[str]:
    """Names of the settings of a node class."""
    return {each.name for each in dataclasses.fields(cls.Settings)}
