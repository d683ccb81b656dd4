"""Plain arrays: .npy, .npz, and .csv with one frame a line."""

from __future__ import annotations

import math
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
    is_npz,
    npy_shape,
    npz_shapes,
    read_npy,
    read_npz,
)
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask

from .recording import (
    Head,
    Lines,
    Parsed,
    Policy,
    Recording,
    check_grid,
    is_missing,
    is_number,
    parse_frame,
    parse_number,
    shown,
    stack_frames,
)

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


class NpyRecording(Recording):
    """One array of shape (n_frames, n_rows, n_cols), any integer or float dtype.

    Raises
    ------
    SourceError
        If the file is no .npy or holds anything else.
    """

    def __init__(self, file: IO[bytes], name: str) -> None:
        self._file, self._name = file, name

    def head(self) -> Head:
        with _refusing(self._name):
            _, n_rows, n_cols = checked_shape(npy_shape(self._file), self._name)
        return Head(n_rows, n_cols, n_rows * n_cols)

    def read(self) -> Parsed:
        raw = _whole(self._file)
        if is_npz(raw):
            raise SourceError(f"{self._name}: holds an archive of arrays; name it .npz")
        with _refusing(self._name):
            return Parsed(forces=_as_frames(read_npy(raw), self._name))


class NpzRecording(Recording):
    """An archive of arrays.

    It holds `forces`, shape (n_frames, n_rows, n_cols), or one 3-D array of any name, and
    optionally `stamp_ns`, shape (n_frames,), rising integers; `rate_hz`, `f_max` and `pitch_m`,
    one number each; `unit`, a text; `mask`, shape (n_rows, n_cols), True or 1 where a taxel
    exists; `points`, float32 of shape (n_taxels, 6): place in metres and unit normal of each taxel
    of a skin that is no flat grid; `point_rows`, whole numbers of shape (n_taxels,): their rows in
    a file of points. Values of cells without a taxel are ignored, and become 0.

    Raises
    ------
    SourceError
        If the file is no .npz, or one of these arrays is not as described.
    """

    def __init__(self, file: IO[bytes], name: str) -> None:
        self._file, self._name = file, name

    def head(self) -> Head:
        file, name = self._file, self._name
        with _refusing(name):
            shapes = npz_shapes(file, lambda held: ["forces"] if "forces" in held else held[:_MOST])
            found = forces_name({key: len(one) for key, one in shapes.items()}, name)
            _, n_rows, n_cols = checked_shape(shapes[found], f"{name}, array {shown(found)}")
            if not npz_shapes(file, lambda held: ["mask"] if "mask" in held else []):
                return Head(n_rows, n_cols, n_rows * n_cols)
            most_bytes = 8 * MAX_ELEMENTS + MAX_HEAD_BYTES
            mask = read_npz(file, lambda _: ["mask"], most_bytes)["mask"]
        return Head(n_rows, n_cols, int(_mask(mask, (n_rows, n_cols), name).sum()))

    def read(self) -> Parsed:
        raw = _whole(self._file)
        with _refusing(self._name):
            if not is_npz(raw):
                read_npy(raw)
                raise SourceError(f"{self._name}: holds a single array; name it .npy")
            arrays = read_npz(
                raw, lambda held: [key for key in held if "forces" not in held or key in NPZ_NAMES]
            )
        return parsed_arrays(arrays, self._name)


def parsed_arrays(arrays: Mapping[str, npt.NDArray[Any]], name: str) -> Parsed:
    """A recording of arrays as in `NpzRecording`, of any container; raises as it does."""
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


class PlainCsvRecording(Recording):
    """Numbers separated by commas, one frame a line, row after row of the skin.

    Blank lines and lines that begin with `#` are skipped. If only one of `n_rows` and `n_cols`
    is stated, the other follows from the length of a line. Readings that are not finite (an empty
    cell, too) or below 0 are kept where `policy` does not refuse them.

    Raises
    ------
    SourceError
        If no shape is stated, a line has not n_rows x n_cols numbers, or one is not a finite
        number >= 0.
    """

    def __init__(
        self, lines: Lines, n_rows: int | None, n_cols: int | None, policy: Policy
    ) -> None:
        self._lines, self._policy = lines, policy
        tokens = self._next()
        if tokens is None:
            raise SourceError(f"{lines.name}: the recording holds no frame")
        where = lines.where
        if not (is_number(tokens[0]) or is_missing(tokens[0], policy)):
            raise SourceError(
                f"{where}: {shown(tokens[0])} is not a number; allowed: an export of Tekscan or "
                f"XSENSOR, or numbers with one frame a line{_vendor(','.join(tokens))}"
            )
        if n_rows is None or n_cols is None:
            n_rows, n_cols = _stated_shape(len(tokens), n_rows, n_cols, where)
        check_grid(n_rows, n_cols, lines.name)
        self._shape = n_rows, n_cols
        self._first = self._frame(tokens)

    def head(self) -> Head:
        return Head(*self._shape, math.prod(self._shape))

    def read(self) -> Parsed:
        frames = [self._first]
        while (tokens := self._next()) is not None:
            frames.append(self._frame(tokens))
        return Parsed(forces=stack_frames(frames, self._lines.name))

    def _next(self) -> list[str] | None:
        """The cells of the next line that is neither blank nor a comment; None at the end."""
        for line in self._lines:
            if line.strip() and not line.lstrip().startswith("#"):
                return [token.strip() for token in line.split(",")]
        return None

    def _frame(self, tokens: list[str]) -> Doubles:
        (n_rows, n_cols), where = self._shape, self._lines.where
        if len(tokens) != n_rows * n_cols:
            raise SourceError(
                f"{where}: holds {len(tokens)} cells, but n_rows x n_cols = "
                f"{n_rows} x {n_cols} needs {n_rows * n_cols}"
            )
        return parse_frame(tokens, where, self._shape, self._policy)


def _vendor(line: str) -> str:
    """What is known of a header line that is not read."""
    if line.startswith("sole_id,timestamp"):
        return " (an export of StappOne has sensors of an insole, which form no grid)"
    if line.startswith("stamp_ns,"):
        return " (an exported topic of a bag is not read; export it to npz, which is)"
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
    if array.dtype.kind not in "iuf":
        raise SourceError(
            f"{where}: dtype {shown(array.dtype)}; allowed are integers and floating point"
        )
    checked_shape(array.shape, where)
    return array


def checked_shape(shape: tuple[int, ...], where: str) -> tuple[int, ...]:
    """The shape of frames; SourceError unless it has three dimensions."""
    if len(shape) != 3:
        raise SourceError(
            f"{where}: has {len(shape)} dimensions, shape {shape}; "
            "expected three: (frames, rows, columns)"
        )
    return shape


def _whole(file: IO[bytes]) -> bytes:
    """All bytes of a file of which some have been read."""
    file.seek(0)
    return file.read()


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
