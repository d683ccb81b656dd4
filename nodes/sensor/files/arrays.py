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
from sparseskin.nodes.numerics.arrays import Doubles, Mask

from .recording import (
    Head,
    Lines,
    Parsed,
    Policy,
    Recording,
    check_grid,
    is_missing,
    parse_number,
    parse_reading,
    shown,
    stack_frames,
)

_MOST = 64
"""Arrays of an .npz without `forces` whose shapes are looked at."""
FORCES = "forces"
NUMBERS = ("rate_hz", "f_max", "pitch_m")
NPZ_NAMES = (FORCES, "stamp_ns", *NUMBERS, "mask", "unit", "points", "point_rows")
"""Names of the arrays that are read from an .npz; all others are ignored."""


class ArrayRecording(Recording):
    """One array, or an archive of arrays.

    An archive holds `forces`, shape (n_frames, n_rows, n_cols), of any integer or float dtype, or
    one 3-D array of any name, and optionally `stamp_ns`, shape (n_frames,), rising integers;
    `rate_hz`, `f_max` and `pitch_m`, one number each; `unit`, a text; `mask`, shape (n_rows,
    n_cols), True or 1 where a taxel exists; `points`, float32 of shape (n_taxels, 6): place in
    metres and unit normal of each taxel of a skin that is no flat grid; `point_rows`, int32 of
    shape (n_taxels,): their rows in a file of points. Values of cells without a taxel are ignored,
    and become 0.

    Raises
    ------
    SourceError
        If the file is no such one, or one of these arrays is not as described.
    """

    def __init__(self, file: IO[bytes], name: str) -> None:
        self._file, self._name = file, name

    def head(self) -> Head:
        file, name = self._file, self._name
        with _refusing(name):
            archive = is_npz(file.read(8))
            file.seek(0)
            if not archive:
                _, n_rows, n_cols = _checked_shape(npy_shape(file), name)
                return Head(n_rows, n_cols, n_rows * n_cols)
            shapes = npz_shapes(file, lambda held: [FORCES] if FORCES in held else held[:_MOST])
            found = _forces_name({key: len(one) for key, one in shapes.items()}, name)
            _, n_rows, n_cols = _checked_shape(shapes[found], f"{name}, array {shown(found)}")
            most_bytes = 8 * MAX_ELEMENTS + MAX_HEAD_BYTES
            held = read_npz(file, lambda held: ["mask"] if "mask" in held else [], most_bytes)
        mask = _mask(held, (n_rows, n_cols), name)
        return Head(n_rows, n_cols, n_rows * n_cols if mask is None else int(mask.sum()))

    def read(self) -> Parsed:
        self._file.seek(0)
        raw, name = self._file.read(), self._name
        with _refusing(name):
            if not is_npz(raw):
                return Parsed(forces=_as_frames(read_npy(raw), name))
            arrays = read_npz(
                raw, lambda held: [key for key in held if FORCES not in held or key in NPZ_NAMES]
            )
        found = _forces_name({key: array.ndim for key, array in arrays.items()}, name)
        forces = _as_frames(arrays[found], f"{name}, array {shown(found)}")
        mask = _mask(arrays, forces.shape[1:], name)
        if mask is not None:
            forces = np.where(mask, forces, forces.dtype.type(0))
        unit = arrays.get("unit")
        if unit is not None and (unit.shape != () or unit.dtype.kind != "U"):
            raise SourceError(f"{name}, array 'unit': expected one text, e.g. np.array('N')")
        stamps = arrays.get("stamp_ns")
        numbers = {
            key: _scalar(arrays[key], f"{name}, array '{key}'") for key in NUMBERS if key in arrays
        }
        return Parsed(
            forces=forces,
            unit=None if unit is None else str(unit),
            stamp_ns=None if stamps is None else _stamps(stamps, len(forces), name),
            mask=mask,
            points=arrays.get("points"),
            point_rows=arrays.get("point_rows"),
            **numbers,
        )


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
        where, n_cells = lines.where, len(tokens)
        try:
            float(tokens[0])
        except ValueError:
            if not is_missing(tokens[0], policy):
                raise SourceError(
                    f"{where}: {shown(tokens[0])} is not a number; allowed: an export of Tekscan "
                    f"or XSENSOR, or numbers with one frame a line{_vendor(','.join(tokens))}"
                ) from None
        if not (n_rows or n_cols):
            raise SourceError(
                f"{where}: a .csv of numbers does not state its shape; set n_rows and n_cols "
                f"(this line holds {n_cells} cells)"
            )
        n_rows = n_rows or n_cells // (n_cols or 1)
        self._shape = n_rows, n_cols or n_cells // n_rows
        check_grid(*self._shape, lines.name)
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
        readings = [
            parse_reading(token, where, *divmod(k, n_cols), self._policy)
            for k, token in enumerate(tokens)
        ]
        return np.array(readings).reshape(self._shape)


def _vendor(line: str) -> str:
    """What is known of a header line that is not read."""
    if line.startswith("sole_id,timestamp"):
        return " (an export of StappOne has sensors of an insole, which form no grid)"
    if line.startswith("stamp_ns,"):
        return " (an exported topic of a bag is not read; export it to npz, which is)"
    if "boditrak" in line.lower():
        return " (an export of BodiTrak is not read; save its frames as plain numbers)"
    return ""


@contextmanager
def _refusing(name: str) -> Iterator[None]:
    try:
        yield
    except ArrayFileError as error:
        raise SourceError(f"{name}: {error}") from error


def _forces_name(dimensions: Mapping[str, int], name: str) -> str:
    """The array that holds the frames, by the number of dimensions of each; SourceError if it is
    not `forces`, nor the only one of three dimensions.
    """
    if FORCES in dimensions:
        return FORCES
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
    _checked_shape(array.shape, where)
    return array


def _checked_shape(shape: tuple[int, ...], where: str) -> tuple[int, ...]:
    """The shape of frames; SourceError unless it has three dimensions."""
    if len(shape) != 3:
        raise SourceError(
            f"{where}: has {len(shape)} dimensions, shape {shape}; "
            "expected three: (frames, rows, columns)"
        )
    return shape


def _mask(arrays: Mapping[str, npt.NDArray[Any]], shape: tuple[int, ...], name: str) -> Mask | None:
    array, where = arrays.get("mask"), f"{name}, array 'mask'"
    if array is None:
        return None
    if array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
        raise SourceError(f"{where}: expected bool (True where a taxel exists), or 0 and 1")
    if array.shape != shape:
        raise SourceError(f"{where}: shape {array.shape}, but the frames have {shape}")
    return array.astype(np.bool_)


def _stamps(array: npt.NDArray[Any], n_frames: int, name: str) -> tuple[int, ...]:
    where = f"{name}, array 'stamp_ns'"
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


def _scalar(array: npt.NDArray[Any], where: str) -> float:
    if array.size != 1 or array.dtype.kind not in "iuf":
        raise SourceError(f"{where}: expected one number")
    value = parse_number(str(array.reshape(())[()]), where)
    if value <= 0:
        raise SourceError(f"{where}: {value:g} must be above 0")
    return value
