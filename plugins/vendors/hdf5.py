"""Arrays in files of HDF5, .h5, to which a .mat of version 7.3 belongs."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from sparseskin.nodes.errors import SourceError, not_installed
from sparseskin.nodes.numerics.array_files import MAX_GROWN_BYTES, MAX_GROWTH
from sparseskin.nodes.numerics.arrays import AnyArray
from sparseskin.nodes.sensor.files.dataset_recording import DatasetRecording, text_of
from sparseskin.nodes.sensor.files.datasets import (
    FILL_VALUES,
    MAX_ARRAYS,
    OFFSET,
    SCALE,
    UNIT,
    ArrayFile,
    Dataset,
)
from sparseskin.nodes.sensor.files.recording import File
from sparseskin.nodes.sensor.layout.checks import unreadable

_BEGIN = b"\x89HDF\r\n\x1a\n"
_MATLAB_CLASS = "MATLAB_class"
MAX_CHUNK_BYTES = 1 << 30
"""Memory of the chunks that hold some frames together, chosen."""
_OF_ARRAY = frozenset({UNIT, "units", "long_name", SCALE, OFFSET, *FILL_VALUES})
"""Attributes that hold for an array alone, not for those in a group that has them."""


def is_hdf5(begin: bytes) -> bool:
    return begin.startswith(_BEGIN)


class Hdf5Recording(DatasetRecording):
    """The frames of an .h5."""

    def __init__(self, file: File) -> None:
        super().__init__(file, Hdf5File(file))


class Hdf5File(ArrayFile):
    """The datasets of a file of HDF5; links to others are not followed. With `is_matlab` its axes
    are those of MATLAB, which writes them in reverse, and paths have dots. Raises SourceError if it
    is malformed, or h5py is not installed.
    """

    def __init__(self, file: File, is_matlab: bool = False) -> None:
        super().__init__(file.name)
        self._file = file.file
        self._is_matlab = is_matlab
        self._groups: dict[str, dict[str, Any]] = {}
        self._limit = max(MAX_GROWN_BYTES, MAX_GROWTH * self._file.seek(0, 2))
        self.has_frames_first = not is_matlab
        self.separator = "." if is_matlab else "/"
        with self._opened() as opened:
            self._list(opened)

    def whole(self, key: str) -> AnyArray:
        self._check_size(key)
        with self._opened() as opened:
            dataset = opened[key.replace(self.separator, "/")]
            return self._as_read(key, self._readable(key, dataset)[()])

    def blocks(self, key: str, axis: int, size: int) -> Iterator[AnyArray]:
        sides = self.datasets[key].sides
        stored_axis = axis
        if self._is_matlab:
            stored_axis = len(sides) - 1 - axis
        self._check_size(key)
        with self._opened() as opened:
            dataset = opened[key.replace(self.separator, "/")]
            step = self._step(key, dataset, stored_axis, size)
            readable = self._readable(key, dataset)
            whole_axes = (slice(None),) * stored_axis
            for begin in range(0, sides[axis], step):
                part = readable[(*whole_axes, slice(begin, begin + step))]
                yield np.moveaxis(self._as_read(key, part), axis, 0)

    def _step(self, key: str, dataset: Any, axis: int, size: int) -> int:
        """Entries of an axis that are read together: whole chunks, each inflated once."""
        if not dataset.chunks:
            return size

        length = int(dataset.chunks[axis])
        n_entries = max(1, dataset.shape[axis])
        n_together = dataset.size // n_entries * min(length, n_entries)
        row_bytes = n_together * dataset.dtype.itemsize
        # HDF5 inflates a chunk whole, whatever part of it is read.
        needed = max(row_bytes, math.prod(dataset.chunks) * dataset.dtype.itemsize)
        if needed > MAX_CHUNK_BYTES:
            raise SourceError(
                f"{self.where(key)}: chunks of {length} entries of axis {axis + 1} "
                f"need {needed} bytes; at most {MAX_CHUNK_BYTES}"
            )
        return max(1, size // length) * length

    def _check_size(self, key: str) -> None:
        n_bytes = self.datasets[key].n_bytes
        if n_bytes > self._limit:
            raise SourceError(
                f"{self.where(key)}: {n_bytes} bytes; at most {self._limit}"
            )

    def _readable(self, key: str, dataset: Any) -> Any:
        if self.datasets[key].dtype.kind == "U":
            return dataset.asstr()
        return dataset

    def _as_read(self, key: str, array: Any) -> AnyArray:
        dtype: Any = self.datasets[key].dtype
        if dtype.kind == "U":
            dtype = np.str_
        values = np.asarray(array).astype(dtype, copy=False)
        if self._is_matlab:
            return values.transpose()
        return values

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        try:
            import h5py
        except ImportError as error:
            fault = not_installed("h5py", "hdf5")
            raise SourceError(f"{self.name}: {fault}") from error

        try:
            with h5py.File(self._file, "r") as opened:
                yield opened
        except SourceError:
            raise
        except Exception as error:
            # HDF5 may raise anything at malformed bytes.
            raise unreadable(self.name, error) from error

    def _list(self, opened: Any) -> None:
        """List the datasets, with their labels and attributes."""
        import h5py

        def look(path: str, entry: Any) -> bool | None:
            # Soft and external links are not followed.
            if not isinstance(entry, h5py.Dataset):
                return None
            if entry.external or entry.is_virtual:
                return None
            # MATLAB keeps there what it refers to from elsewhere.
            if not path.startswith("#"):
                self._add(path, entry)
            # Anything but None ends the walk.
            return len(self.datasets) >= MAX_ARRAYS or None

        opened.visititems(look)

    def _add(self, path: str, dataset: Any) -> None:
        if dataset.shape is None:
            return
        of_dataset = dict(_attributes(dataset))
        dtype = _dtype(dataset)
        sides = tuple(map(int, dataset.shape))
        labels = tuple(_label(axis) for axis in dataset.dims)
        if self._is_matlab:
            kind = text_of(of_dataset.get(_MATLAB_CLASS, ""))
            if kind in ("char", "cell") or "MATLAB_empty" in of_dataset:
                return
            if kind == "logical":
                dtype = np.dtype("?")
            # MATLAB writes its axes in reverse.
            sides = sides[::-1]
            labels = labels[::-1]

        key = path.replace("/", self.separator)
        attributes = {**self._around(dataset.parent), **of_dataset}
        self.datasets[key] = Dataset(sides, dtype, labels, attributes)

    def _around(self, group: Any) -> dict[str, Any]:
        """Attributes of a group and those around it that may hold for the arrays within."""
        if group.name not in self._groups:
            around: dict[str, Any] = {}
            if group.name != "/":
                around = self._around(group.parent)
            of_group = dict(_attributes(group))
            for name in of_group.keys() & _OF_ARRAY:
                del of_group[name]
            self._groups[group.name] = {**around, **of_group}
        return self._groups[group.name]


def _attributes(entry: Any) -> Iterator[tuple[str, Any]]:
    """Attributes of a dataset or a group that are numbers or texts, with names in small letters
    too; those that cannot be decoded are left out.
    """
    for name in entry.attrs:
        try:
            value = entry.attrs[name]
        except (OSError, TypeError, ValueError, KeyError):
            continue
        yield name.lower(), value
        yield name, value


def _dtype(dataset: Any) -> np.dtype[Any]:
    import h5py

    if h5py.check_string_dtype(dataset.dtype):
        return np.dtype("U1")
    dtype: np.dtype[Any] = dataset.dtype
    return dtype


def _label(axis: Any) -> str:
    """The label of an axis, or else the name of its only scale."""
    if axis.label:
        return str(axis.label)
    names = [name.rpartition("/")[2] for name in axis if name]
    return names[0] if len(names) == 1 else ""
