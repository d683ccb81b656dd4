"""MATLAB's .mat: version 5 to 7.2 by SciPy, version 7.3, which is HDF5, by h5py."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError

from .arrays import NPZ_NAMES, forces_name, parsed_arrays
from .hdf5 import MATLAB_CLASS, Hdf5Recording
from .isolated import in_child
from .parsed import Head, Parsed, Recording, shown

_NUMERIC = (
    "double",
    "single",
    "logical",
    *(f"{u}int{b}" for u in ("", "u") for b in (8, 16, 32, 64)),
)
_COMPRESSED = 15
_HEAD_BYTES = 128
_PIECE = 1 << 20
NO_ORDER = (
    ": a .mat does not state which of its dimensions are rows and columns; set n_rows and n_cols"
)


class MatRecording(Recording):
    """A variable `forces`, or the only numeric one with three dimensions: rows, columns and
    frames, or frames, rows and columns, as `n_rows` and `n_cols` decide; one frame has two.

    The other variables are read as those of an .npz.

    Raises
    ------
    SourceError
        If the file is no .mat, holds more than is allowed, does not state one such variable,
        its order of dimensions is not decided, or a variable is not as in an .npz.
    """

    def __init__(self, file: IO[bytes], name: str, n_rows: int | None, n_cols: int | None) -> None:
        self._name, self._stated = name, (n_rows, n_cols)
        # Version 7.3 is HDF5.
        self._is_hdf5 = file.read(_HEAD_BYTES).startswith((b"\x89HDF", b"MATLAB 7.3"))
        self._n_bytes = file.seek(0, io.SEEK_END)

    def head(self) -> Head:
        found = self._in_child("read_shape")
        shape = tuple(found["shape"].tolist())
        shape = shape[::-1] if self._is_hdf5 else shape
        n_rows, n_cols = shape[:2] if self._frame_axis(shape) == 2 else shape[-2:]
        return Head(n_rows, n_cols, None if found["has_mask"] else n_rows * n_cols)

    def read(self) -> Parsed:
        name, arrays = self._name, self._in_child("read_arrays")
        if arrays.pop(MATLAB_CLASS, False):
            arrays = {key: array.T for key, array in arrays.items()}
        arrays = {key: _plain(key, array) for key, array in arrays.items()}
        key = forces_name({key: array.ndim for key, array in arrays.items()}, name)
        forces = arrays[key]
        axis = self._frame_axis(forces.shape)
        arrays[key] = np.moveaxis(forces[:, :, None] if forces.ndim == 2 else forces, axis, 0)
        return parsed_arrays(arrays, name)

    def _in_child(self, function: str) -> dict[str, npt.NDArray[Any]]:
        module = Hdf5Recording.__module__ if self._is_hdf5 else __name__
        return in_child(f"{module}:{function}", self._name, self._n_bytes)

    def _frame_axis(self, shape: tuple[int, ...]) -> int:
        """Which dimension counts the frames: 2 or 0; 2 of one frame, whose array has two."""
        (n_rows, n_cols), sizes = self._stated, " x ".join(map(str, shape))
        if len(shape) not in (2, 3) or (n_rows is None and n_cols is None):
            raise SourceError(f"{self._name}{NO_ORDER} (it holds {sizes})")
        for axis, (rows, cols) in ((2, shape[:2]), (0, shape[-2:])):
            if n_rows in (None, rows) and n_cols in (None, cols):
                return axis
        raise SourceError(
            f"{self._name}: holds {sizes}, which is not n_rows = {n_rows}, n_cols = {n_cols} "
            "and frames"
        )


def read_shape(name: str, most: int) -> dict[str, npt.NDArray[Any]]:
    """Shape of the variable of frames, and whether there is a mask; runs in a child."""
    with open(name, "rb") as file:
        held = _variables(file, file.read(_HEAD_BYTES), name)
    dimensions = {key: len(shape) for key, shape in held.items() if key not in NPZ_NAMES[1:]}
    shape = held[forces_name(dimensions, name)]
    return {"shape": np.array(shape), "has_mask": np.array("mask" in held)}


def read_arrays(name: str, most: int) -> dict[str, npt.NDArray[Any]]:
    """The variables that are read, of at most `most` bytes together; runs in a child."""
    raw = Path(name).read_bytes()
    _check_growth(raw, name, most)
    held = _variables(io.BytesIO(raw), raw, name)
    wanted = [key for key in held if "forces" not in held or key in NPZ_NAMES]
    from scipy.io import loadmat

    try:
        found = loadmat(io.BytesIO(raw), variable_names=wanted)
    except Exception as error:  # SciPy and zlib raise many kinds
        raise SourceError(f"{name}: not a readable .mat file ({shown(error, 80)})") from error
    return {key: found[key] for key in wanted if isinstance(found.get(key), np.ndarray)}


def _variables(file: IO[bytes], head: bytes, name: str) -> dict[str, tuple[int, ...]]:
    """Shapes of the variables that may be read: those of numbers, and the text `unit`."""
    if not head.startswith(b"MATLAB 5.0") or len(head) < _HEAD_BYTES:
        raise SourceError(f"{name}: not a .mat file of MATLAB 5 or later")
    from scipy.io import whosmat

    file.seek(0)
    try:
        held = whosmat(file)
    except Exception as error:
        raise SourceError(f"{name}: not a readable .mat file ({shown(error, 80)})") from error
    found = {
        str(key): tuple(int(side) for side in shape)
        for key, shape, kind in held
        if kind in _NUMERIC or (key, kind) == ("unit", "char")
    }
    if any(min(shape, default=0) < 0 for shape in found.values()):
        raise SourceError(f"{name}: not a readable .mat file (a side below 0)")
    return found


def _check_growth(raw: bytes, name: str, most: int) -> None:
    """Refuse compressed variables that would fill the memory: zeros shrink to a thousandth."""
    order = ">" if raw[126:128] == b"MI" else "<"
    at, total = _HEAD_BYTES, 0
    while at + 8 <= len(raw):
        kind, size = struct.unpack_from(f"{order}II", raw, at)
        if kind == _COMPRESSED:
            plain, rest = zlib.decompressobj(), memoryview(raw)[at + 8 : at + 8 + size]
            try:
                piece = plain.decompress(rest, _PIECE)
                while piece and total <= most:
                    total += len(piece)
                    piece = plain.decompress(plain.unconsumed_tail, _PIECE)
            except zlib.error as error:
                raise SourceError(f"{name}: not a readable .mat file ({error})") from error
        if total > most:
            raise SourceError(f"{name}: its variables are larger than {most} bytes")
        at += 8 + size


def _plain(key: str, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A variable as NumPy would hold it: MATLAB has no array of less than two dimensions, and
    numbers are floating point by default.
    """
    if key in ("rate_hz", "f_max", "pitch_m", "unit") and array.size == 1:
        return array.reshape(())
    if key == "stamp_ns":
        flat = array.reshape(-1)
        whole = flat.dtype.kind == "f" and bool(np.all(np.abs(flat) < 2.0**53))
        return flat.astype(np.int64) if whole and np.array_equal(flat, np.rint(flat)) else flat
    if key == "mask" and array.dtype.kind == "f" and np.isin(array, (0, 1)).all():
        return array.astype(np.bool_)
    return array
