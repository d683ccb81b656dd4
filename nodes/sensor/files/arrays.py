"""Plain arrays: .npy and .npz."""

from __future__ import annotations

import io
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
from sparseskin.nodes.numerics.arrays import Mask

from .recording import File, Head, Parsed, Recording, choose, parse_number, shown

_MOST = 64
"""Arrays of an .npz whose shapes are looked at."""
FORCES = "forces"
NUMBERS = ("rate_hz", "f_max", "pitch_m")
TIMES = ("stamp_ns", "rate_hz")
NPZ_NAMES = (FORCES, "stamp_ns", *NUMBERS, "mask", "unit", "points", "point_rows")
"""Names of the arrays that are read from an .npz; all others are ignored."""


class ArrayRecording(Recording):
    """One array, or an archive of arrays.

    The frames have the shape (n_frames, n_rows, n_cols) or (n_frames, n_cells), and any integer or
    float dtype. In an archive they are the array of the stated topic, or `forces`, or the only 3-D
    one, or the only 2-D one; optional are `stamp_ns`, shape (n_frames,), rising integers;
    `rate_hz`, `f_max` and `pitch_m`, one number each; `unit`, a text; `mask`, shape (n_rows,
    n_cols), True or 1 where a taxel exists; `points`, float32 of shape (n_taxels, 6): place in
    metres and unit normal of each taxel of a skin that is no flat grid; `point_rows`, int32 of
    shape (n_taxels,): their rows in a file of points. Values of cells without a taxel are ignored,
    and become 0. Raises SourceError if one of these arrays is not as described.
    """

    def __init__(self, file: File) -> None:
        self._of, self._file, self._name = file, file.file, file.name

    def head(self) -> Head:
        file, name = self._file, self._name
        with _refusing(name):
            archive = is_npz(file.read(8))
            file.seek(0)
            if not archive:
                shape = check_dimensions(npy_shape(file), name)[1:]
                return Head(shape, math.prod(shape), is_timed=False)
            shapes, found = self._shapes(file)
            shape = check_dimensions(shapes[found], f"{name}, array {shown(found)}")[1:]
            most_bytes = 8 * MAX_ELEMENTS + MAX_HEAD_BYTES
            masks = read_npz(file, lambda held: ["mask"] if "mask" in held else [], most_bytes)
        mask = _mask(masks, shape, name)
        is_timed, unit = not shapes.keys().isdisjoint(TIMES), "" if "unit" in shapes else None
        return Head(shape, math.prod(shape) if mask is None else int(mask.sum()), unit, is_timed)

    def read(self) -> Parsed:
        self._file.seek(0)
        raw, name = self._file.read(), self._name
        with _refusing(name):
            if not is_npz(raw):
                return Parsed(forces=as_frames(read_npy(raw), name))
            wanted = (found := self._shapes(io.BytesIO(raw))[1], *NPZ_NAMES)
            arrays = read_npz(raw, lambda held: [key for key in held if key in wanted])
        forces = as_frames(arrays[found], f"{name}, array {shown(found)}")
        mask = _mask(arrays, forces.shape[1:], name)
        if mask is not None:
            forces = np.where(mask, forces, forces.dtype.type(0))
        unit = arrays.get("unit")
        if unit is not None and (unit.shape != () or unit.dtype.kind != "U"):
            raise SourceError(f"{name}, array 'unit': expected one text, e.g. np.array('N')")
        stamps = arrays.get("stamp_ns")
        held = [key for key in NUMBERS if key in arrays]
        more: dict[str, Any] = {key: arrays.get(key) for key in ("points", "point_rows")}
        more |= {key: _scalar(arrays[key], f"{name}, array '{key}'") for key in held}
        return Parsed(
            forces=forces,
            unit=None if unit is None else str(unit),
            stamp_ns=None if stamps is None else _stamps(stamps, len(forces), name),
            mask=mask,
            **more,
        )

    def _shapes(self, file: IO[bytes]) -> tuple[dict[str, tuple[int, ...]], str]:
        """Shapes of the arrays of an archive that may be used, and the name of the frames."""
        topic = self._of.topic

        def wanted(held: list[str]) -> list[str]:
            known = [key for key in held if key in (topic, *NPZ_NAMES)]
            return known if (topic or FORCES) in held else held[:_MOST]

        shapes = npz_shapes(file, wanted)
        return shapes, frames_name({k: len(one) for k, one in shapes.items()}, topic, self._name)


def frames_name(dimensions: Mapping[str, int], stated: str | None, name: str) -> str:
    """The array of a file that holds the frames, by the dimensions of each: the stated one,
    `forces`, or the only one of three, or else of two. SourceError if there is none, or not one.
    """
    if stated is None and FORCES in dimensions:
        return FORCES
    wanted = {key: f"{n}-D" for key, n in dimensions.items() if n == 3}
    if stated is not None or not wanted:
        others = set() if stated is not None else {*NPZ_NAMES}
        wanted |= {key: "2-D" for key, n in dimensions.items() if n == 2 and key not in others}
    return choose(wanted, stated, name, "arrays of frames, (frames, rows, columns)")


def as_frames(array: npt.NDArray[Any], where: str) -> npt.NDArray[Any]:
    """The array itself; SourceError unless it holds frames of real numbers."""
    if array.dtype.kind not in "iuf":
        fault = f"dtype {shown(array.dtype)}; allowed are integers and floating point"
        raise SourceError(f"{where}: {fault}")
    check_dimensions(array.shape, where)
    return array


def check_dimensions(shape: tuple[int, ...], where: str) -> tuple[int, ...]:
    """The shape of frames; SourceError unless it has two or three dimensions."""
    if len(shape) not in (2, 3):
        expected = "expected three: (frames, rows, columns), or two: (frames, readings)"
        raise SourceError(f"{where}: has {len(shape)} dimensions, shape {shape}; {expected}")
    return shape


@contextmanager
def _refusing(name: str) -> Iterator[None]:
    try:
        yield
    except ArrayFileError as error:
        raise SourceError(f"{name}: {error}") from error


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
            fault = f"stamp {k} is {stamp}, not after the one before it, {before}"
            raise SourceError(f"{where}: {fault}")
    return tuple(stamp - stamps[0] for stamp in stamps)


def _scalar(array: npt.NDArray[Any], where: str) -> float:
    if array.size != 1 or array.dtype.kind not in "iuf":
        raise SourceError(f"{where}: expected one number")
    value = parse_number(str(array.reshape(())[()]), where)
    if value <= 0:
        raise SourceError(f"{where}: {value:g} must be above 0")
    return value
