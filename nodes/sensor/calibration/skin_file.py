"""Reader and writer of skin.toml, the file that describes one skin, its calibration included.

A file is untrusted until it has been checked: its size is bounded before it is read, and so are
those of its arrays, which are numbers only and lie beside it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.errors import MessageError
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.files import whole_file
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.numerics.array_files import ArrayFileError, read_npz
from sparseskin.nodes.sensor.files.recording import parse_mask, reading
from sparseskin.nodes.sensor.points import point_skins
from sparseskin.nodes.toml import parse_toml

from .description import (
    MAX_KNOTS,
    MAX_NAME,
    Response,
    SkinDescription,
    SkinFileError,
    points_on_grid,
)

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
BESIDE = {**{key: key for key in (*GRIDS, "points")}, "response_reading": CURVE["reading"]}
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
    text = _read(path, 4 * MAX_FILE_CHARS)
    try:
        table = parse_toml(text.decode("utf-8"), MAX_FILE_CHARS)
    except ValueError as error:
        raise SkinFileError(f"{path}: not TOML: {' '.join(str(error).split())[:200]}") from error
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
    values = _placed(table, folder) if "points" in table else dict(table)
    for key in ("name", "n_rows", "n_cols", "f_max"):
        if key not in values:
            raise SkinFileError(f"{key}: is missing")
    stated = {key: values.pop(key) for key in GRIDS if key in values}
    curve = values.pop("response", {})
    beside = values.pop(ARRAYS, None)
    if not isinstance(curve, Mapping):
        raise SkinFileError("response: expected a table of reading and force")
    _check_keys(curve, CURVE, "response.")
    stated |= {CURVE[key]: value for key, value in curve.items()}
    skin = SkinDescription(**values)  # its shape bounds the size of all arrays
    held = {} if beside is None else _load_arrays(beside, folder, skin.n_rows * skin.n_cols)
    for key in held:
        if key in stated:
            raise SkinFileError(f"{key}: is stated in the file and in its {ARRAYS}")
    arrays = held | {key: _array(key, value, skin) for key, value in stated.items()}
    if knots := {key: arrays.pop(key) for key in CURVE.values() if key in arrays}:
        for key in CURVE.values():
            if key not in knots:
                raise SkinFileError(f"{key}: is missing")
        arrays["response"] = Response(**{name: knots[key] for name, key in CURVE.items()})
    if skin.placement is not None:
        placed = skin.placement.skin(skin.f_max, skin.unit)
        arrays |= {"mask": placed.mask, "points": points_on_grid(placed)}
    return replace(skin, **arrays)


def _check_keys(table: Iterable[str], known: Iterable[str], before: str = "") -> None:
    for key in table:
        if key not in known:
            raise SkinFileError(f"{before}{key[:40]}: unknown key{did_you_mean(key[:40], known)}")


def _placed(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A table with the grid and placement of the file with points that it names."""
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
    n_rows, n_cols = found.shape
    grid = {"n_rows": n_rows, "n_cols": n_cols, "pitch_mm": 1000 * found.pitch_m}
    return {**table, "points": None, **grid, "placement": found}


def _read(path: Path, most: int) -> bytes:
    """The bytes of a regular file of at most `most`."""
    try:
        with reading(str(path)) as file:
            raw = file.read(most + 1)
    except SourceError as error:
        raise SkinFileError(str(error)) from error
    if len(raw) > most:
        raise SkinFileError(f"{path}: more than {most} bytes")
    return raw


def _load_arrays(name: object, folder: Path, n_cells: int) -> dict[str, Any]:
    """The arrays of the .npz that a file names, by their keys."""
    if not isinstance(name, str) or not name.endswith(".npz"):
        raise SkinFileError(f"{ARRAYS}: expected the name of an .npz, got {ascii(name)[:40]}")
    path = folder / name
    beside = name == Path(name).name and "\\" not in name and name.isprintable()
    if not beside or path.resolve().parent != folder.resolve():
        raise SkinFileError(f"{ARRAYS}: {ascii(name)[:80]} is not a file beside the skin's own")
    most = n_cells * (8 * (2 + MAX_KNOTS) + 4 * 6 + 1) + (1 << 16)
    try:
        held = read_npz(_read(path, most), list, most)
        _check_keys(held, BESIDE)
    except (ArrayFileError, SkinFileError) as error:
        raise SkinFileError(f"{ARRAYS}: {name}: {error}") from error
    return {BESIDE[key]: array.copy() for key, array in held.items()}  # aligned


def _array(key: str, value: Any, skin: SkinDescription) -> npt.NDArray[Any]:
    """The value of a key as an array. Its shape is checked with those of the others."""
    if key == "mask":
        return parse_mask(value, skin.shape, key)
    try:
        found = np.array(value)
    except ValueError:  # lists of different lengths
        found = np.array("")
    if found.dtype.kind not in "iuf":
        raise SkinFileError(f"{key}: expected numbers, in lists of one length each")
    found = found.astype(np.float64)
    if key not in GRIDS:
        return np.atleast_1d(found)
    if not found.ndim:
        return np.full(skin.shape, found)
    if skin.placement is None:
        return found
    if found.ndim != 1:
        raise SkinFileError(f"{key}: expected one number, or a list of one a taxel")
    try:
        return skin.placement.on_grid(found, unused=1.0)
    except SourceError as error:
        raise SkinFileError(f"{key}: {error}") from error


def save_skin(path: str | os.PathLike[str], skin: SkinDescription) -> list[Path]:
    """Write a skin.toml, and beside it an .npz where arrays are large; return both paths.
    `load_skin` returns the same description, bit for bit.

    Raises SkinFileError if the name does not end in .toml, OutputError if one of the files exists,
    or cannot be written.
    """
    path = Path(path)
    beside = path.with_suffix(".npz")
    if path.suffix != ".toml":
        raise SkinFileError(f"{path}: expected a name that ends in .toml")
    plain = ("name", "n_rows", "n_cols", "pitch_mm", "unit", "f_max", *OF_NOISE)
    values: dict[str, Any] = {key: getattr(skin, key) for key in (*plain, *GRIDS, "points")}
    curve = {} if skin.response is None else dict(vars(skin.response))
    values["response_reading"] = curve.get("reading")
    for key in ("baseline", "gains"):
        if values[key] is not None and np.ptp(values[key]) == 0:
            values[key] = float(values[key].flat[0])
    large: dict[str, Any] = {key: one for key, one in values.items() if np.ndim(one) > 1}
    if skin.points is None and sum(array.size for array in large.values()) <= MAX_INLINE:
        large = {}
    if skin.mask is not None:
        values["mask"] = ["".join("01"[cell] for cell in row) for row in skin.mask.tolist()]
    stated = values | {ARRAYS: beside.name if large else None, **dict.fromkeys(large)}
    curve["reading"] = stated.pop("response_reading")
    lines = ["# A skin of sparseskin: docs/howto/calibration.md has the meaning of each key."]
    lines += [f"{key} = {_toml(one)}" for key, one in stated.items() if one is not None]
    if skin.response is not None:
        lines += ["", "[response]"]
        lines += [f"{key} = {_toml(one)}" for key, one in curve.items() if one is not None]
    text = "\n".join(lines) + "\n"
    # What cannot be read again is not written.
    if len(text) > MAX_FILE_CHARS:
        raise SkinFileError(f"{path}: would have {len(text)} characters; at most {MAX_FILE_CHARS}")
    with whole_file(path) as draft:
        draft.write_text(text, encoding="utf-8")
        if not large:
            return [path]
        with whole_file(beside) as arrays_draft, arrays_draft.open("wb") as file:
            np.savez_compressed(file, **large)
    return [path, beside]


def _toml(value: Any) -> str:
    """Numbers, printable text and lists as TOML, which has those of JSON; a row a line."""
    value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    if isinstance(value, list) and isinstance(value[0], list | str):
        return "[\n" + "".join(f"    {_toml(one)},\n" for one in value) + "]"
    return json.dumps(value, ensure_ascii=False)
