"""Reader and writer of skin.toml, the file that describes one skin, its calibration included.

A file is untrusted until it has been checked: its size is bounded before it is read, and so are
those of its arrays, which are numbers only and lie beside it.
"""

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages.errors import MessageError
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.files import whole_file
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.numerics.array_files import ArrayFileError, read_npz
from sparseskin.nodes.numerics.arrays import AnyArray, mask_texts
from sparseskin.nodes.toml import parse_toml

from .calibration.description import (
    MAX_KNOTS,
    MAX_NAME,
    Response,
    SkinDescription,
    SkinFileError,
    points_on_grid,
)
from .layout.checks import parse_mask, reading
from .points import point_skins

MAX_FILE_CHARS = 1 << 18
"""Longest skin.toml, chosen: eight thousand numbers, as a program writes them."""
MAX_INLINE = 4096
"""Most numbers of all arrays that are written into the file itself, chosen: baseline and gains of
32 x 32 taxels, with a shared curve, are half of them."""
ARRAYS = "arrays"
"""Key that names the .npz with the large arrays."""
KEYS = (*(f.name for f in fields(SkinDescription) if f.name != "placement"), ARRAYS)
"""Keys of a skin.toml."""
GRIDS = ("mask", "baseline", "gains")
"""Keys of what each taxel has."""
OF_NOISE = ("noise", "noise_mid", "f_min")
OF_POINTS = ("n_rows", "n_cols", "pitch_mm", "mask")
"""Keys that are not stated beside `points`: they follow from these."""
CURVE = {"reading": "response.reading", "force": "response.force"}
"""Keys of the table `response`, and their names in errors."""
BESIDE = {
    **{key: key for key in (*GRIDS, "points")},
    "response_reading": CURVE["reading"],
}
"""Arrays of the .npz, and the keys that they stand for."""


def load_skin(path: str | os.PathLike[str]) -> SkinDescription:
    """Read and check a skin.toml, and the .npz that it names.

    Its keys are `KEYS`: n_rows, n_cols and f_max are required; `name` is by default that of the
    file. `mask` is a list of texts, one a row, of 1 (a taxel) and 0 (none). `baseline` and `gains`
    are one number for all taxels, or a list of rows. `response` is a table of `reading` and
    `force`. Instead, an .npz beside the file, named by `arrays`, holds `mask`, `baseline`, `gains`
    and `response_reading`.

    `points` names a file with the places of the taxels, in place of n_rows, n_cols, pitch_mm and
    mask; `baseline` and `gains` are then one number, or a list of numbers in the order of that
    file. Points that are on a grid already are an array of the .npz.

    Raises SkinFileError if a file is missing, no regular file, too large or malformed, a key is
    unknown or missing, or a value is not allowed.
    """
    path = Path(path)
    # UTF-8 has at most four bytes for a character.
    text = _read(path, 4 * MAX_FILE_CHARS)
    try:
        table = parse_toml(text.decode("utf-8"), MAX_FILE_CHARS)
    except ValueError as error:
        fault = " ".join(str(error).split())
        raise SkinFileError(f"{path}: not TOML: {fault[:200]}") from error
    return parse_skin({"name": path.stem[:MAX_NAME], **table}, str(path), path.parent)


def parse_skin(table: Mapping[str, Any], where: str, folder: Path) -> SkinDescription:
    """The skin that a table of a TOML file describes, with the keys of a skin.toml. Errors, those
    of `load_skin`, begin with `where`; `arrays` is searched in `folder`.
    """
    try:
        return _described(table, folder)
    except (SkinFileError, SourceError, MessageError) as error:
        raise SkinFileError(f"{where}: {error}") from error


def _described(table: Mapping[str, Any], folder: Path) -> SkinDescription:
    _check_keys(table, KEYS)
    values = dict(table)
    if "points" in table:
        values = _placed(table, folder)
    for key in ("name", "n_rows", "n_cols", "f_max"):
        if key not in values:
            raise SkinFileError(f"{key}: is missing")

    # No array may be both in the file and in its .npz.
    inline = {key: values.pop(key) for key in GRIDS if key in values}
    curve = values.pop("response", {})
    archive = values.pop(ARRAYS, None)
    if not isinstance(curve, Mapping):
        raise SkinFileError("response: expected a table of reading and force")
    _check_keys(curve, CURVE, "response.")
    for name, knots in curve.items():
        inline[CURVE[name]] = knots

    # Its shape bounds the size of all arrays, so that it is checked before any is read.
    skin = SkinDescription(**values)
    arrays: dict[str, Any] = {}
    if archive is not None:
        arrays = _load_arrays(archive, folder, skin.n_rows * skin.n_cols)
    for key in arrays:
        if key in inline:
            raise SkinFileError(f"{key}: is stated in the file and in its {ARRAYS}")
    for key, value in inline.items():
        arrays[key] = _array(key, value, skin)

    if any(key in arrays for key in CURVE.values()):
        arrays["response"] = _take_response(arrays)
    # The mask of a virtual grid follows from its points.
    if skin.placement is not None:
        placed = skin.placement.skin(skin.f_max, skin.unit)
        arrays["mask"] = placed.mask
        arrays["points"] = points_on_grid(placed)
    return replace(skin, **arrays)


def _take_response(arrays: dict[str, Any]) -> Response:
    """The response curve; its arrays are taken out of those by key."""
    for key in CURVE.values():
        if key not in arrays:
            raise SkinFileError(f"{key}: is missing")
    return Response(**{name: arrays.pop(key) for name, key in CURVE.items()})


def _check_keys(table: Iterable[str], allowed: Iterable[str], prefix: str = "") -> None:
    for key in table:
        if key not in allowed:
            hint = did_you_mean(key[:40], allowed)
            raise SkinFileError(f"{prefix}{key[:40]}: unknown key{hint}")


def _placed(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A table with the grid and placement of the file with points that it names."""
    for key in OF_POINTS:
        if key in table:
            raise SkinFileError(
                f"{key}: is stated beside points, from which it follows"
            )
    name = table["points"]
    if not isinstance(name, str) or not name:
        raise SkinFileError("points: expected the name of a file")

    # A path in a file is relative to that file.
    layout = name
    if not name.startswith("example:"):
        layout = str(folder / name)
    try:
        placement = point_skins().place(layout)
    except SourceError as error:
        raise SkinFileError(f"points: {error}") from error
    n_rows, n_cols = placement.shape
    return {
        **table,
        "points": None,
        "n_rows": n_rows,
        "n_cols": n_cols,
        "pitch_mm": 1000 * placement.pitch_m,
        "placement": placement,
    }


def _read(path: Path, max_bytes: int) -> bytes:
    """The bytes of a regular file of at most `max_bytes`."""
    try:
        with reading(str(path)) as file:
            # One byte more shows that the file is too large.
            raw = file.read(max_bytes + 1)
    except SourceError as error:
        raise SkinFileError(str(error)) from error
    if len(raw) > max_bytes:
        raise SkinFileError(f"{path}: more than {max_bytes} bytes")
    return raw


def _load_arrays(name: object, folder: Path, n_cells: int) -> dict[str, Any]:
    """The arrays of the .npz that a file names, by their keys."""
    if not isinstance(name, str) or not name.endswith(".npz"):
        raise SkinFileError(
            f"{ARRAYS}: expected the name of an .npz, got {ascii(name)[:40]}"
        )

    # A file of a stranger must not name one elsewhere, by ".." or a symbolic link; "\\" is a
    # separator on Windows alone.
    path = folder / name
    is_plain = name == Path(name).name and "\\" not in name and name.isprintable()
    if not is_plain or path.resolve().parent != folder.resolve():
        raise SkinFileError(
            f"{ARRAYS}: {ascii(name)[:80]} is not a file beside the skin's own"
        )

    # Baseline, gains and knots in float64, points in float32, the mask, and the headers.
    bytes_per_cell = 8 * (2 + MAX_KNOTS) + 4 * 6 + 1
    max_bytes = n_cells * bytes_per_cell + (1 << 16)
    try:
        arrays = read_npz(_read(path, max_bytes), list, max_bytes)
        _check_keys(arrays, BESIDE)
    except (ArrayFileError, SkinFileError) as error:
        raise SkinFileError(f"{ARRAYS}: {name}: {error}") from error
    # A copy is aligned.
    return {BESIDE[key]: array.copy() for key, array in arrays.items()}


def _array(key: str, value: Any, skin: SkinDescription) -> AnyArray:
    """The value of a key as an array. Its shape is checked with those of the others."""
    if key == "mask":
        return parse_mask(value, skin.shape, key)
    try:
        array = np.array(value)
    except ValueError:  # lists of different lengths
        array = np.array("")
    if array.dtype.kind not in "iuf":
        raise SkinFileError(f"{key}: expected numbers, in lists of one length each")

    array = array.astype(np.float64)
    if key not in GRIDS:
        return np.atleast_1d(array)
    if not array.ndim:
        return np.full(skin.shape, array)
    if skin.placement is None:
        return array
    if array.ndim != 1:
        raise SkinFileError(f"{key}: expected one number, or a list of one a taxel")
    try:
        return skin.placement.on_grid(array, unused=1.0)
    except SourceError as error:
        raise SkinFileError(f"{key}: {error}") from error


def save_skin(path: str | os.PathLike[str], skin: SkinDescription) -> list[Path]:
    """Write a skin.toml, and beside it an .npz where arrays are large; return both paths.
    `load_skin` returns the same description, bit for bit.

    Raises SkinFileError if the name does not end in .toml, OutputError if one of the files exists,
    or cannot be written.
    """
    path = Path(path)
    archive = path.with_suffix(".npz")
    if path.suffix != ".toml":
        raise SkinFileError(f"{path}: expected a name that ends in .toml")

    values = _values(skin)
    large = {key: value for key, value in values.items() if np.ndim(value) > 1}
    n_numbers = sum(array.size for array in large.values())
    # Points have no form as text: `points` of a skin.toml names a file.
    if skin.points is None and n_numbers <= MAX_INLINE:
        large = {}
    text = _text(skin, values, large, archive.name)
    # What cannot be read again is not written.
    if len(text) > MAX_FILE_CHARS:
        raise SkinFileError(
            f"{path}: would have {len(text)} characters; at most {MAX_FILE_CHARS}"
        )

    # The archive first: no skin.toml ever names a file that is not there.
    with whole_file(path) as draft:
        draft.write_text(text, encoding="utf-8")
        if not large:
            return [path]
        with whole_file(archive) as arrays_draft, arrays_draft.open("wb") as file:
            np.savez_compressed(file, **large)
    return [path, archive]


def _values(skin: SkinDescription) -> dict[str, Any]:
    """The values of a description by key, one number for an array of equal ones."""
    numbers = ("name", "n_rows", "n_cols", "pitch_mm", "unit", "f_max", *OF_NOISE)
    keys = (*numbers, *GRIDS, "points")
    values = {key: getattr(skin, key) for key in keys}
    if skin.response is not None:
        values["response_reading"] = skin.response.reading
    for key in ("baseline", "gains"):
        array = values[key]
        if array is not None and np.ptp(array) == 0:
            values[key] = float(array.flat[0])
    return values


def _text(
    skin: SkinDescription,
    values: Mapping[str, Any],
    large: Mapping[str, Any],
    archive: str,
) -> str:
    """The text of a skin.toml whose `large` arrays are in an .npz of the name `archive`."""
    inline = {key: value for key, value in values.items() if key not in large}
    knots = inline.pop("response_reading", None)
    if skin.mask is not None and "mask" in inline:
        inline["mask"] = mask_texts(skin.mask)
    if large:
        inline[ARRAYS] = archive

    # Tables come behind all keys: in TOML what follows one belongs to it.
    lines = [
        "# A skin of sparseskin: docs/howto/calibration.md has the meaning of each key."
    ]
    lines += _toml_lines(inline)
    if skin.response is not None:
        lines += ["", "[response]"]
        lines += _toml_lines({"reading": knots, "force": skin.response.force})
    return "\n".join(lines) + "\n"


def _toml_lines(values: Mapping[str, Any]) -> list[str]:
    """A line, or lines, for each key that has a value."""
    return [
        f"{key} = {_toml(value)}" for key, value in values.items() if value is not None
    ]


def _toml(value: Any) -> str:
    """Numbers, printable text and lists as TOML, which has those of JSON; a row a line."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list) and isinstance(value[0], list | str):
        rows = "".join(f"    {_toml(row)},\n" for row in value)
        return f"[\n{rows}]"
    return json.dumps(value, ensure_ascii=False)
