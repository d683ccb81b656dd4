"""Writer of skin.toml; the inverse of `load_skin`."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.ranges import is_whole
from sparseskin.nodes.files import whole_file
from sparseskin.nodes.numerics.arrays import Doubles

from .description import SkinDescription
from .response import SkinFileError
from .skin_file import ARRAYS, ARRAYS_SUFFIX, MAX_FILE_CHARS

MAX_INLINE = 4096
"""Most numbers of all arrays that are written into the file itself, chosen: baseline and gains of
32 x 32 taxels, with a shared curve, are half of them."""


def save_skin(path: str | os.PathLike[str], skin: SkinDescription) -> list[Path]:
    """Write a skin.toml, and beside it an .npz where arrays are large; return both paths.

    `load_skin` returns the same description, bit for bit.

    Raises
    ------
    SkinFileError
        If the name does not end in .toml.
    OutputError
        If one of the files exists, or cannot be written.
    """
    path = Path(path)
    if path.suffix != ".toml":
        raise SkinFileError(f"{path}: expected a name that ends in .toml")
    large = _large_arrays(skin)
    if skin.points is None and sum(array.size for array in large.values()) <= MAX_INLINE:
        large = {}
    arrays = path.with_suffix(ARRAYS_SUFFIX)
    text = _text(skin, large, arrays.name)
    # What cannot be read again is not written.
    if len(text) > MAX_FILE_CHARS:
        raise SkinFileError(f"{path}: would have {len(text)} characters; at most {MAX_FILE_CHARS}")
    with whole_file(path) as draft:
        draft.write_text(text, encoding="utf-8")
        if not large:
            return [path]
        with whole_file(arrays) as arrays_draft, arrays_draft.open("wb") as file:
            np.savez_compressed(file, **large)  # type: ignore[arg-type]
    return [path, arrays]


def _large_arrays(skin: SkinDescription) -> dict[str, npt.NDArray[Any]]:
    """Arrays of a skin that are written beside its file: those that are not one number."""
    found: dict[str, npt.NDArray[Any]] = {}
    if skin.mask is not None:
        found["mask"] = skin.mask
    if skin.points is not None:
        found["points"] = skin.points
    for key in ("baseline", "gains"):
        grid = getattr(skin, key)
        if grid is not None and not (grid == grid.flat[0]).all():
            found[key] = grid
    if skin.response is not None and skin.response.reading.ndim == 3:
        found["response_reading"] = skin.response.reading
    return found


def _text(skin: SkinDescription, large: Mapping[str, Any], arrays_name: str) -> str:
    """The content of a skin.toml."""
    lines = ["# A skin of sparseskin: docs/calibration.md has the meaning of each key."]
    for key in ("name", "rows", "cols", "pitch_mm", "unit", "f_max", "noise", "noise_mid"):
        value = getattr(skin, key)
        if value is not None:
            lines.append(f"{key} = {_value(value)}")
    if skin.f_min:
        lines.append(f"f_min = {_value(skin.f_min)}")
    if skin.mask is not None and "mask" not in large:
        texts = ["".join("1" if one else "0" for one in row) for row in skin.mask]
        lines += ["mask = [", *(f'    "{text}",' for text in texts), "]"]
    for key in ("baseline", "gains"):
        grid = getattr(skin, key)
        if grid is not None and key not in large:
            lines += _grid_lines(key, grid)
    if large:
        lines.append(f"{ARRAYS} = {_value(arrays_name)}")
    if skin.response is not None:
        lines += ["", "[response]", f"force = {_value(skin.response.force.tolist())}"]
        if "response_reading" not in large:
            lines.append(f"reading = {_value(skin.response.reading.tolist())}")
    return "\n".join(lines) + "\n"


def _grid_lines(key: str, grid: Doubles) -> list[str]:
    if (grid == grid.flat[0]).all():
        return [f"{key} = {_value(float(grid.flat[0]))}"]
    return [f"{key} = [", *(f"    {_value(row.tolist())}," for row in grid), "]"]


def _value(value: Any) -> str:
    """A number, list or printable text as TOML, which has the numbers and texts of JSON."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(int(value) if is_whole(value) else float(value))
