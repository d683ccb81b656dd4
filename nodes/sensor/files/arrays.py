"""Plain arrays: .npy, .npz, and .csv with one frame a line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.fields import MAX_ELEMENTS
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.array_files import (
    MAX_HEAD_BYTES,
    ArrayFileError,
    ArrayPart,
    is_npz,
    npy_parts,
    npy_shape,
    npz_member,
    npz_parts,
    npz_shapes,
    read_npy,
    read_npz,
)
from sparseskin.nodes.numerics.arrays import Floats, Mask

from .parsed import (
    DEFAULT_POLICY,
    REFUSE,
    Parsed,
    Policy,
    check_grid,
    check_part,
    is_missing,
    is_number,
    parse_number,
    parse_reading,
    shown,
    stack_frames,
    text_lines,
)

MAX_CHECKED_BYTES = 1 << 30
"""Readings of an .npy or .npz that are checked before a graph starts, bytes; chosen: seconds. The
sensor checks all."""
_MOST = 64
"""Arrays of an .npz without `forces` whose shapes are looked at."""
NPZ_NAMES = (
    "forces",
    "stamp_ns",
    "rate_hz",
    "mask",
    "f_max",
    "unit",
    "pitch_m",
    "points",
    "point_rows",
)
"""Names of the arrays that are read from an .npz; all others are ignored."""


def parse_npy(raw: bytes, name: str) -> Parsed:
    """Read one array of shape (n_frames, n_rows, n_cols), any integer or float dtype.

    Raises
    ------
    SourceError
        If the bytes are no .npy file or hold anything else.
    """
    if is_npz(raw):
        raise SourceError(f"{name}: holds an archive of arrays; name it .npz")
    with _refusing(name):
        return Parsed(forces=_as_frames(read_npy(raw), name))


def parse_npz(raw: bytes, name: str) -> Parsed:
    """Read an archive of arrays.

    It holds `forces`, shape (n_frames, n_rows, n_cols), or one 3-D array of any name, and
    optionally `stamp_ns`, shape (n_frames,), rising integers; `rate_hz`, `f_max` and `pitch_m`,
    one number each; `unit`, a text; `mask`, shape (n_rows, n_cols), True or 1 where a taxel
    exists; `points`, float32 of shape (n_taxels, 6): place in metres and unit normal of each taxel
    of a skin that is no flat grid; `point_rows`, whole numbers of shape (n_taxels,): their rows in
    a file of points. Values of cells without a taxel are ignored, and become 0.

    Raises
    ------
    SourceError
        If the bytes are no .npz file, or one of these arrays is not as described.
    """
    with _refusing(name):
        if not is_npz(raw):
            read_npy(raw)
            raise SourceError(f"{name}: holds a single array; name it .npy")
        arrays = read_npz(
            raw, lambda held: [key for key in held if "forces" not in held or key in NPZ_NAMES]
        )
    return parsed_arrays(arrays, name)


def parsed_arrays(arrays: Mapping[str, npt.NDArray[Any]], name: str) -> Parsed:
    """A recording of arrays as in `parse_npz`, of a container of any format; raises as it does."""
    found = forces_name({key: array.ndim for key, array in arrays.items()}, name)
    forces = _as_frames(arrays[found], f"{name}, array {shown(found)}")
    mask = _mask(arrays["mask"], forces.shape[1:], name) if "mask" in arrays else None
    if mask is not None:
        forces = np.where(mask, forces, forces.dtype.type(0))
    points = point_rows = None
    if "points" in arrays:
        exists = np.ones(forces.shape[1:], dtype=np.bool_) if mask is None else mask
        points = _points(arrays["points"], exists, f"{name}, array 'points'")
        if "point_rows" in arrays:
            point_rows = _point_rows(arrays["point_rows"], exists, f"{name}, array 'point_rows'")
    unit = None
    if "unit" in arrays:
        if arrays["unit"].shape != () or arrays["unit"].dtype.kind != "U":
            raise SourceError(f"{name}, array 'unit': expected one text, e.g. np.array('N')")
        unit = str(arrays["unit"])
    stamp_ns = None
    if "stamp_ns" in arrays:
        stamp_ns = _stamps(arrays["stamp_ns"], len(forces), f"{name}, array 'stamp_ns'")
    return Parsed(
        forces=forces,
        unit=unit,
        rate_hz=_scalar(arrays, "rate_hz", name),
        stamp_ns=stamp_ns,
        pitch_m=_scalar(arrays, "pitch_m", name),
        mask=mask,
        f_max=_scalar(arrays, "f_max", name),
        points=points,
        point_rows=point_rows,
    )


def _points(array: npt.NDArray[Any], exists: Mask, where: str) -> Floats:
    """Places and normals on the grid, float32 (n_rows, n_cols, 6)."""
    expected = (int(np.count_nonzero(exists)), 6)
    if array.shape != expected or array.dtype != np.float32:
        raise SourceError(
            f"{where}: {array.dtype} of shape {array.shape}; expected float32 of {expected}"
        )
    found = np.zeros((*exists.shape, 6), dtype=np.float32)
    found[exists] = array
    return found


def _point_rows(array: npt.NDArray[Any], exists: Mask, where: str) -> npt.NDArray[np.int32]:
    """Rows of the points on the grid, int32 (n_rows, n_cols)."""
    n = int(np.count_nonzero(exists))
    if array.dtype.kind not in "iu" or array.shape != (n,):
        raise SourceError(
            f"{where}: {array.dtype} of shape {array.shape}; expected whole numbers of ({n},)"
        )
    if not ((array >= 0) & (array <= np.iinfo(np.int32).max)).all():
        raise SourceError(f"{where}: numbers outside 0..{np.iinfo(np.int32).max}")
    found = np.full(exists.shape, -1, dtype=np.int32)
    found[exists] = array
    return found


def npy_file_shape(file: IO[bytes], name: str) -> tuple[int, ...]:
    """Shape of the array of an .npy, from its header.

    Raises
    ------
    SourceError
        If it has no such header.
    """
    with _refusing(name):
        shape = npy_shape(file)
    _check_dimensions(shape, name)
    return shape


def npz_file_shape(file: IO[bytes], name: str) -> tuple[tuple[int, ...], int | None]:
    """Shape of the frames of an .npz, from their header, and the number of taxels by its mask;
    None where it has none.

    Raises
    ------
    SourceError
        If it is no archive, does not hold frames, or the mask is malformed.
    """
    with _refusing(name):
        _, shape, mask = _npz_frames(file, name)
    return shape, None if mask is None else int(mask.sum())


def _npz_frames(file: IO[bytes], name: str) -> tuple[str, tuple[int, ...], Mask | None]:
    """Name and shape of the frames of an .npz, and its mask."""
    shapes = npz_shapes(file, lambda held: ["forces"] if "forces" in held else held[:_MOST])
    found = forces_name({key: len(one) for key, one in shapes.items()}, name)
    shape = shapes[found]
    _check_dimensions(shape, f"{name}, array {shown(found)}")
    if not npz_shapes(file, lambda held: ["mask"] if "mask" in held else []):
        return found, shape, None
    mask = npz_member(file, "mask", 8 * MAX_ELEMENTS + MAX_HEAD_BYTES)
    return found, shape, _mask(mask, shape[1:], name)


def check_npy(file: IO[bytes], name: str, n_bytes: int, policy: Policy) -> None:
    """Check the readings of an .npy of frames, as they are read: the first `MAX_CHECKED_BYTES`.

    Raises
    ------
    SourceError
        If the array is refused by `parse_npy`, or a reading by `policy`.
    """
    with _refusing(name):
        _check_parts(npy_parts(file, n_bytes, MAX_CHECKED_BYTES), name, None, policy, name)


def check_npz(file: IO[bytes], name: str, policy: Policy) -> None:
    """As `check_npy`, of the frames of an .npz, whose shapes are those of `npz_file_shape`."""
    with _refusing(name):
        found, _, mask = _npz_frames(file, name)
        parts = npz_parts(file, found, MAX_CHECKED_BYTES)
        _check_parts(parts, f"{name}, array {shown(found)}", mask, policy, name)


def _check_parts(
    parts: Iterator[ArrayPart], array: str, mask: Mask | None, policy: Policy, name: str
) -> None:
    for part in parts:
        _check_dtype(part.values.dtype, array)
        if part.values.dtype.kind == "u":
            return
        check_part(part, name, policy.low, mask, finite=policy.nan == REFUSE)


def parse_plain_csv(
    raw: bytes,
    name: str,
    n_rows: int | None,
    n_cols: int | None,
    policy: Policy = DEFAULT_POLICY,
) -> Parsed:
    """Read numbers separated by commas, one frame a line, row after row of the skin.

    Blank lines and lines that begin with `#` are skipped. If only one of `n_rows` and `n_cols`
    is stated, the other follows from the length of a line. Readings that are not finite (an empty
    cell, too) or below 0 are kept where `policy` does not refuse them.

    Raises
    ------
    SourceError
        If no shape is stated, a line has not n_rows x n_cols numbers, or one is not a finite
        number >= 0.
    """
    frames: list[npt.NDArray[np.float64]] = []
    for index, line in enumerate(text_lines(raw)):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{name}, line {index + 1}"
        tokens = [token.strip() for token in line.split(",")]
        if not frames and not (is_number(tokens[0]) or is_missing(tokens[0], policy)):
            raise SourceError(
                f"{where}: {shown(tokens[0])} is not a number; allowed: an export of Tekscan or "
                f"XSENSOR, or numbers with one frame a line{_vendor(line)}"
            )
        if n_rows is None or n_cols is None:
            n_rows, n_cols = _stated_shape(len(tokens), n_rows, n_cols, where)
        if not frames:
            check_grid(n_rows, n_cols, name)
        if len(tokens) != n_rows * n_cols:
            raise SourceError(
                f"{where}: holds {len(tokens)} cells, but n_rows x n_cols = "
                f"{n_rows} x {n_cols} needs {n_rows * n_cols}"
            )
        readings = [
            parse_reading(token, where, *divmod(k, n_cols), policy)
            for k, token in enumerate(tokens)
        ]
        frames.append(np.array(readings).reshape(n_rows, n_cols))
    return Parsed(forces=stack_frames(frames, name))


def _vendor(line: str) -> str:
    """What is known of a header line that is not read."""
    if line.startswith("sole_id,timestamp"):
        return " (an export of StappOne has sensors of an insole, which form no grid)"
    if "boditrak" in line.lower():
        return " (an export of BodiTrak is not read; save its frames as plain numbers)"
    return ""


def _stated_shape(
    n_cells: int, n_rows: int | None, n_cols: int | None, where: str
) -> tuple[int, int]:
    stated = n_rows or n_cols
    if stated is None:
        raise SourceError(
            f"{where}: a .csv of numbers does not state its shape; set n_rows and n_cols "
            f"(this line holds {n_cells} cells)"
        )
    what = "n_rows" if n_rows else "n_cols"
    if n_cells % stated:
        raise SourceError(f"{where}: {n_cells} cells cannot be divided by {what} = {stated}")
    other = n_cells // stated
    return (stated, other) if n_rows else (other, stated)


@contextmanager
def _refusing(name: str) -> Iterator[None]:
    try:
        yield
    except ArrayFileError as error:
        raise SourceError(f"{name}: {error}") from error


def forces_name(dimensions: Mapping[str, int], name: str) -> str:
    """The array that holds the frames, by the number of dimensions of each; SourceError if it is
    not `forces`, nor the only one of three dimensions.
    """
    if "forces" in dimensions:
        return "forces"
    candidates = [key for key, n in dimensions.items() if n == 3]
    if len(candidates) == 1:
        return candidates[0]
    held = ", ".join(f"{shown(key)} {n}-D" for key, n in list(dimensions.items())[:8])
    raise SourceError(
        f"{name}: expected an array 'forces' or exactly one 3-D array; it holds {held or 'nothing'}"
    )


def _as_frames(array: npt.NDArray[Any], where: str) -> npt.NDArray[Any]:
    _check_dtype(array.dtype, where)
    _check_dimensions(array.shape, where)
    return array


def _check_dtype(dtype: np.dtype[Any], where: str) -> None:
    if dtype.kind not in "iuf":
        raise SourceError(f"{where}: dtype {shown(dtype)}; allowed are integers and floating point")


def _check_dimensions(shape: tuple[int, ...], where: str) -> None:
    if len(shape) != 3:
        raise SourceError(
            f"{where}: has {len(shape)} dimensions, shape {shape}; "
            "expected three: (frames, rows, columns)"
        )


def _mask(array: npt.NDArray[Any], shape: tuple[int, ...], name: str) -> Mask:
    where = f"{name}, array 'mask'"
    if array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
        raise SourceError(f"{where}: expected bool (True where a taxel exists), or 0 and 1")
    if array.shape != shape:
        raise SourceError(f"{where}: shape {array.shape}, but the frames have {shape}")
    return array.astype(np.bool_)


def _stamps(array: npt.NDArray[Any], n_frames: int, where: str) -> tuple[int, ...]:
    if array.dtype.kind not in "iu":
        raise SourceError(f"{where}: dtype {shown(array.dtype)}; expected whole nanoseconds")
    if array.shape != (n_frames,):
        raise SourceError(f"{where}: shape {array.shape}, expected one a frame: ({n_frames},)")
    # Python integers: a difference of unsigned or of far-apart int64 stamps could wrap round.
    stamps = [int(stamp) for stamp in array]
    for k, (before, stamp) in enumerate(pairwise(stamps), start=1):
        if stamp <= before:
            raise SourceError(
                f"{where}: stamp {k} is {stamp}, not after the one before it, {before}"
            )
    return tuple(stamp - stamps[0] for stamp in stamps)


def _scalar(arrays: Mapping[str, npt.NDArray[Any]], key: str, name: str) -> float | None:
    if key not in arrays:
        return None
    array = arrays[key]
    if array.size != 1 or array.dtype.kind not in "iuf":
        raise SourceError(f"{name}, array '{key}': expected one number")
    value = parse_number(str(array.reshape(())[()]), f"{name}, array '{key}'")
    if value <= 0:
        raise SourceError(f"{name}, array '{key}': {value:g} must be above 0")
    return value
