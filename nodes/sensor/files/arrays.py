"""Plain arrays: .npy and .npz."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.array_blocks import StoredArray
from sparseskin.nodes.numerics.array_files import (
    MAX_GROWN_BYTES,
    MAX_GROWTH,
    ArrayFileError,
    NpyHeader,
    is_npz,
    npy_header,
    opened_npz,
)
from sparseskin.nodes.sensor.layout.times import is_time_name

from .dataset_recording import DatasetRecording
from .datasets import MAX_ARRAYS, ArrayFile, Dataset
from .recording import File


class ArrayRecording(DatasetRecording):
    """The frames of an .npy or .npz."""

    def __init__(self, file: File) -> None:
        super().__init__(file, NumpyFile(file))


class StoredArrays(ArrayFile):
    """Arrays whose numbers stand in a file, or in parts of it that are inflated, one after the
    other.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.stored: dict[str, StoredArray] = {}
        #: Fields of the records of each array; () where it holds none.
        self._fields: dict[str, tuple[str, ...]] = {}

    def add(self, key: str, array: StoredArray, dtype: np.dtype[Any]) -> None:
        """Add an array whose numbers are of another dtype than it stands in the file with; of one
        of records each field that is an array or a time, and the others together.
        """
        fields = dtype.fields
        if fields is None or len(array.shape) != 1:
            self._add(key, array, Dataset(array.shape, dtype))
            return
        # As np.genfromtxt and records of drivers have it: a field for each column, or one array.
        numbers = []
        for name in fields:
            of_field = dtype[name]
            if of_field.shape or is_time_name(name):
                sides = array.shape + of_field.shape
                labels = ("frames", *("",) * len(of_field.shape))
                dataset = Dataset(sides, of_field.base, labels)
                path = f"{key}{self.separator}{name}" if key else name
                self._add(path, array, dataset, (name,))
            elif of_field.kind in "iufb":
                numbers.append(name)
        if numbers:
            common = np.result_type(*(dtype[name] for name in numbers))
            sides = (*array.shape, len(numbers))
            names = {1: tuple(numbers)}
            dataset = Dataset(sides, common, ("frames", ""), names=names)
            self._add(key or "fields", array, dataset, tuple(numbers))

    def whole(self, key: str) -> npt.NDArray[Any]:
        with refusing(self.where(key)):
            return self._numbers(key, self.stored[key].whole())

    def blocks(self, key: str, axis: int, size: int) -> Iterator[npt.NDArray[Any]]:
        with refusing(self.where(key)):
            for block in self.stored[key].blocks(axis, size):
                yield self._numbers(key, block)

    def _add(
        self,
        key: str,
        array: StoredArray,
        dataset: Dataset,
        fields: tuple[str, ...] = (),
    ) -> None:
        self.stored[key] = array
        self.datasets[key] = dataset
        self._fields[key] = fields

    def _numbers(self, key: str, block: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """The numbers of an array in a block of what stands in the file."""
        dataset = self.datasets[key]
        fields = self._fields[key]
        if len(fields) == 1 and len(dataset.sides) != 2:
            block = block[fields[0]]
        elif fields:
            parts = [block[name].reshape(len(block), -1) for name in fields]
            block = np.concatenate(parts, axis=1, dtype=dataset.dtype)
        return block.astype(dataset.dtype, copy=False)


class NumpyFile(StoredArrays):
    """The array of an .npy, named "", or those of an .npz. Raises SourceError if the file is
    malformed, or its arrays are far larger than the file.
    """

    def __init__(self, file: File) -> None:
        super().__init__(file.name)
        self._file = file.file
        with refusing(file.name):
            n_bytes = self._file.seek(0, io.SEEK_END)
            self._file.seek(0)
            if is_npz(self._file.read(8)):
                self._add_members(n_bytes)
            else:
                self._file.seek(0)
                self._add_npy(
                    "", npy_header(self._file, n_bytes), self._opened, can_seek=True
                )

    def _add_npy(
        self, key: str, header: NpyHeader, opened: Any, can_seek: bool
    ) -> None:
        def open_at_first() -> Any:
            return opened(header.offset)

        array = StoredArray(
            open_at_first, header.dtype, header.shape, header.by_columns, can_seek
        )
        self.add(key, array, header.dtype)

    @contextmanager
    def _opened(self, offset: int) -> Iterator[IO[bytes]]:
        self._file.seek(offset)
        yield self._file

    def _add_members(self, n_bytes: int) -> None:
        # A small .npz can claim to become any size.
        limit = max(MAX_GROWN_BYTES, MAX_GROWTH * n_bytes)
        with opened_npz(self._file) as (archive, members):
            arrays = [
                item for item in members.items() if item[1].filename.endswith(".npy")
            ]
            # Headers alone are read: the numbers stay in the file until they are needed.
            for name, member in arrays[:MAX_ARRAYS]:
                if member.file_size > limit:
                    fault = (
                        f"would have {member.file_size} bytes, of a file of {n_bytes}"
                    )
                    raise ArrayFileError(
                        f"array {ascii(name)[:40]} {fault}; at most {limit}"
                    )
                self._add_member(archive, name, member)

    def _add_member(
        self, archive: zipfile.ZipFile, name: str, member: zipfile.ZipInfo
    ) -> None:
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ArrayFileError(
                f"array {ascii(name)[:40]}: compressed in a way unknown to NumPy"
            )

        @contextmanager
        # A member cannot be sought in: each pass inflates it from its begin.
        def opened(offset: int) -> Iterator[IO[bytes]]:
            with opened_npz(self._file) as (archive, _), archive.open(member) as stream:
                stream.read(offset)
                yield stream

        with archive.open(member) as stream:
            header = npy_header(stream, member.file_size)
        self._add_npy(name, header, opened, can_seek=False)


@contextmanager
def refusing(where: str) -> Iterator[None]:
    """Raise what is wrong with an array as a SourceError."""
    try:
        yield
    except ArrayFileError as error:
        raise SourceError(f"{where}: {error}") from error
