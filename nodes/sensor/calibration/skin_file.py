"""Reader of skin.toml, the file that describes one skin, its calibration included.

A file is untrusted until it has been checked: its size is bounded before it is read, and so are
those of its arrays, which are numbers only and lie beside it.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages.errors import MessageError
from sparseskin.messages.ranges import is_real
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.numerics.array_files import ArrayFileError, read_npz
from sparseskin.nodes.numerics.arrays import Doubles, Mask
from sparseskin.nodes.sensor.placement import Placement
from sparseskin.nodes.sensor.points import point_skins
from sparseskin.nodes.toml import parse_toml

from .description import MAX_NAME, SkinDescription, points_on_grid
from .response import MAX_KNOTS, Response, SkinFileError

MAX_FILE_CHARS = 1 << 18
"""Longest skin.toml, chosen: eight thousand numbers, as a program writes them."""
ARRAYS_SUFFIX = ".npz"
ARRAYS = "arrays"
"""Key that names the .npz with the large arrays."""
KEYS = (*(f.name for f in fields(SkinDescription) if f.name != "placement"), ARRAYS)
"""Keys of a skin.toml."""
REQUIRED = ("rows", "cols", "f_max")
_RESPONSE_KEYS = ("reading", "force")
OF_POINTS = ("rows", "cols", "pitch_mm", "mask")
"""Keys that are not stated beside `points`: they follow from these."""
_ARRAY_NAMES = ("mask", "baseline", "gains", "response_reading", "points")
"""Arrays of the .npz: those of the same names, and `response.reading`."""
_DTYPES: dict[str, Any] = {"mask": np.bool_, "points": np.float32}
"""Dtypes of these; float64 of the others."""


def load_skin(path: str | os.PathLike[str]) -> SkinDescription:
    """Read and check a skin.toml, and the .npz that it names.

    Parameters
    ----------
    path : str or path
        A TOML file with the keys of `KEYS`: rows, cols and f_max are required; `name` is by default
        that of the file. `mask` is a list of texts, one a row, of 1 (a taxel) and 0 (none).
        `baseline` and `gains` are one number for all taxels, or a list of rows. `response` is a
        table of `reading` and `force`. Instead, an .npz beside the file, named by `arrays`, holds
        `mask`, `baseline`, `gains` and `response_reading`.

        `points` names a file with the places of the taxels (`layouts.files`), in place of rows,
        cols, pitch_mm and mask; `baseline` and `gains` are then one number, or a list of numbers
        in the order of that file. Points that are on a grid already are an array of the .npz.

    Raises
    ------
    SkinFileError
        If a file is missing, no regular file, too large or malformed, a key is unknown or missing,
        or a value is not allowed.
    """
    path = Path(path)
    text = _read(path, 4 * MAX_FILE_CHARS)
    try:
        table = parse_toml(text.decode("utf-8"), MAX_FILE_CHARS)
    except ValueError as error:
        raise SkinFileError(f"{path}: not TOML: {' '.join(str(error).split())[:200]}") from error
    return parse_skin({"name": path.stem[:MAX_NAME], **table}, str(path), path.parent)


def parse_skin(table: Mapping[str, Any], where: str, folder: Path) -> SkinDescription:
    """The skin that a table of a TOML file describes, with the keys of a skin.toml.

    Parameters
    ----------
    table : mapping
        As `parse_toml` returns it.
    where : str
        Begin of errors: the file, and the table in it.
    folder : path
        Folder of the file, in which `arrays` is searched.

    Raises
    ------
    SkinFileError
        As `load_skin` does.
    """
    try:
        for key in table:
            if key not in KEYS:
                raise SkinFileError(f"{key[:40]}: unknown key{did_you_mean(key[:40], KEYS)}")
        if "points" in table:
            table = {key: value for key, value in table.items() if key != "points"} | _placed(
                table, folder
            )
        for key in ("name", *REQUIRED):
            if key not in table:
                raise SkinFileError(f"{key}: is missing")
        values = {key: value for key, value in table.items() if key != ARRAYS}
        # The shape is checked first: it bounds the size of all arrays.
        plain = ("mask", "baseline", "gains", "response")
        placement: Placement | None = values.pop("placement", None)
        found = SkinDescription(**{key: v for key, v in values.items() if key not in plain})
        arrays = _load_arrays(table[ARRAYS], folder, found.shape) if ARRAYS in table else {}
        for key in arrays:
            if key in values or (key == "response_reading" and "reading" in _response(values)):
                raise SkinFileError(f"{key}: is stated in the file and in its {ARRAYS}")
        mask = arrays.get("mask")
        if "mask" in values:
            mask = _mask(values["mask"], found.shape)
        grids: dict[str, Any] = {
            key: _grid(key, values[key], found.shape, placement)
            if key in values
            else arrays.get(key)
            for key in ("baseline", "gains")
        }
        curve = None
        if "response" in values or "response_reading" in arrays:
            curve = _curve(_response(values), arrays.get("response_reading"), found.shape)
        points = arrays.get("points")
        if placement is not None:
            skin = placement.skin(found.f_max, found.unit)
            mask, points = skin.mask, points_on_grid(skin)
        return replace(
            found, mask=mask, response=curve, points=points, placement=placement, **grids
        )
    except SkinFileError as error:
        raise SkinFileError(f"{where}: {error}") from error
    except MessageError as error:
        raise SkinFileError(f"{where}: {error}") from error


def _read(path: Path, most: int) -> bytes:
    """The bytes of a regular file of at most `most`."""
    try:
        # A pipe would wait for its writer.
        with open(path, "rb", opener=lambda p, flags: os.open(p, flags | os.O_NONBLOCK)) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise SkinFileError(f"{path}: is no regular file")
            raw = file.read(most + 1)
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise SkinFileError(f"{str(path)[:200]}: cannot be read ({why})") from error
    if len(raw) > most:
        raise SkinFileError(f"{path}: more than {most} bytes")
    return raw


def _load_arrays(name: object, folder: Path, shape: tuple[int, int]) -> dict[str, Any]:
    """The arrays of the .npz that a file names, each with its dtype checked."""
    if not isinstance(name, str) or not name.endswith(ARRAYS_SUFFIX):
        raise SkinFileError(f"{ARRAYS}: expected the name of an .npz, got {ascii(name)[:40]}")
    path = folder / name
    beside = name == Path(name).name and "\\" not in name and name.isprintable()
    if not beside or path.resolve().parent != folder.resolve():
        raise SkinFileError(f"{ARRAYS}: {ascii(name)[:80]} is not a file beside the skin's own")
    size = shape[0] * shape[1]
    most = size * (8 * (2 + MAX_KNOTS) + 4 * 6 + 1) + (1 << 16)
    try:
        raw = _read(path, most)
        held = read_npz(raw, lambda names: _known_arrays(names), most)
    except (ArrayFileError, SkinFileError) as error:
        raise SkinFileError(f"{ARRAYS}: {name}: {error}") from error
    found: dict[str, Any] = {}
    for key, array in held.items():
        wanted = np.dtype(_DTYPES.get(key, np.float64))
        if array.dtype != wanted:
            raise SkinFileError(f"{ARRAYS}: {name}: {key} is {array.dtype}; expected {wanted}")
        fits = array.shape == (*shape, 6) if key == "points" else array.shape[-2:] == shape
        if not fits or array.ndim != (3 if key in ("response_reading", "points") else 2):
            raise SkinFileError(
                f"{ARRAYS}: {name}: {key} has shape {array.shape}; the skin has {shape}"
            )
        found[key] = array.copy()  # aligned, and apart from the bytes of the file
    return found


def _known_arrays(names: list[str]) -> list[str]:
    for name in names:
        if name not in _ARRAY_NAMES:
            hint = did_you_mean(name[:40], _ARRAY_NAMES)
            raise ArrayFileError(f"{ascii(name)[:40]}: unknown array{hint}")
    if len(set(names)) != len(names):
        raise ArrayFileError("holds an array twice")
    return names


def _mask(value: Any, shape: tuple[int, int]) -> Mask:
    rows, cols = shape
    if not isinstance(value, list) or len(value) != rows:
        raise SkinFileError(f"mask: expected a list of {rows} texts of {cols} characters 0 and 1")
    for k, line in enumerate(value):
        if not isinstance(line, str) or len(line) != cols or set(line) - {"0", "1"}:
            raise SkinFileError(f"mask: row {k}: expected {cols} characters 0 and 1")
    return np.array([[char == "1" for char in line] for line in value], dtype=np.bool_)


def _grid(
    key: str, value: Any, shape: tuple[int, int], placement: Placement | None = None
) -> Doubles:
    """One number for all taxels, or a list of rows; of points, a list in their order."""
    if is_real(value):
        return np.full(shape, float(value))
    if placement is not None:
        if not isinstance(value, list) or not all(map(is_real, value)):
            raise SkinFileError(f"{key}: expected one number, or a list of one a taxel")
        try:
            return placement.on_grid(np.array(value, dtype=np.float64), unused=1.0)
        except SourceError as error:
            raise SkinFileError(f"{key}: {error}") from error
    rows, cols = shape
    if not isinstance(value, list) or len(value) != rows:
        raise SkinFileError(f"{key}: expected one number, or a list of {rows} rows of {cols}")
    for k, line in enumerate(value):
        if not isinstance(line, list) or len(line) != cols or not all(map(is_real, line)):
            raise SkinFileError(f"{key}: row {k}: expected {cols} finite numbers")
    return np.array(value, dtype=np.float64)


def _placed(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Grid and placement of the file with points that a table names."""
    for key in OF_POINTS:
        if key in table:
            raise SkinFileError(f"{key}: is stated beside points, from which it follows")
    name = table["points"]
    if not isinstance(name, str) or not name:
        raise SkinFileError("points: expected the name of a file")
    try:
        found = point_skins().place(name if name.startswith("example:") else str(folder / name))
    except SourceError as error:
        raise SkinFileError(f"points: {error}") from error
    rows, cols = found.shape
    return {"rows": rows, "cols": cols, "pitch_mm": 1000 * found.pitch_m, "placement": found}


def _response(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The table `response`, {} where there is none."""
    table = values.get("response", {})
    if not isinstance(table, Mapping):
        raise SkinFileError("response: expected a table of reading and force")
    for key in table:
        if key not in _RESPONSE_KEYS:
            hint = did_you_mean(key[:40], _RESPONSE_KEYS)
            raise SkinFileError(f"response.{key[:40]}: unknown key{hint}")
    return table


def _curve(table: Mapping[str, Any], reading: Doubles | None, shape: tuple[int, int]) -> Response:
    if "force" not in table:
        raise SkinFileError("response.force: is missing")
    force = _numbers("response.force", table["force"])
    if reading is not None:
        return Response(reading, force)
    if "reading" not in table:
        raise SkinFileError("response.reading: is missing")
    value = table["reading"]
    if isinstance(value, list) and any(isinstance(one, list) for one in value):
        grids = [_grid(f"response.reading, knot {k}", v, shape) for k, v in enumerate(value)]
        return Response(np.stack(grids), force)
    return Response(_numbers("response.reading", value), force)


def _numbers(key: str, value: Any) -> Doubles:
    if not isinstance(value, list) or not all(map(is_real, value)):
        raise SkinFileError(f"{key}: expected a list of numbers")
    if not 1 <= len(value) <= MAX_KNOTS:
        raise SkinFileError(f"{key}: {len(value)} knots; allowed are 1..{MAX_KNOTS}")
    return np.array(value, dtype=np.float64)
