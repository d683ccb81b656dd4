"""Arrays in files of MATLAB, .mat, and HDF5, .h5, to which a .mat of version 7.3 belongs."""

from __future__ import annotations

import io
import struct
import sys
import zlib
from collections.abc import Iterator
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.array_files import MAX_GROWN_BYTES, MAX_GROWTH
from sparseskin.nodes.process.isolation import child_status, output_of
from sparseskin.nodes.sensor.files.arrays import as_frames, frames_name
from sparseskin.nodes.sensor.files.recording import File, Parsed, Recording, unreadable

_HDF5 = b"\x89HDF\r\n\x1a\n"
_HEAD, _COMPRESSED = 128, 15
"""Bytes of the header of a .mat, and the type of its compressed elements."""
_MOST = 4096
"""Datasets of a file that are looked at."""


class ArraysRecording(Recording):
    """The array of the stated topic, its name or path in the file (log.left.forces of structures of
    MATLAB), or `forces`, or the only one of three dimensions. MATLAB's have the frames last, as
    forces(:, :, k), unless only the first dimension leaves the stated shape; those of two
    dimensions have a row a frame, as all of HDF5. Raises SourceError if the file is malformed, no
    array or several fit, or h5py is not installed.
    """

    def __init__(self, file: File) -> None:
        self._file = file

    def read(self) -> Parsed:
        file, name = self._file.file, self._file.name
        is_matlab = name.lower().endswith(".mat")
        begin = file.read(520)
        try:
            if begin.startswith(_HDF5) or begin[512:] == _HDF5:
                key, array = self._hdf5()
                array = array.T if is_matlab else array
            else:
                file.seek(0)
                key, array = self._mat(file.read())
        except SourceError:
            raise
        except Exception as error:  # of SciPy and HDF5, at malformed bytes of any kind
            raise unreadable(name, error) from error
        array = as_frames(array, f"{name}, array {key}")
        if not is_matlab or array.ndim != 3:
            return Parsed(array)
        stated = self._file.n_rows, self._file.n_cols
        is_last = None in stated or array.shape[:2] == stated or array.shape[1:] != stated
        array = np.moveaxis(array, -1, 0) if is_last else array
        return Parsed(
            array,
            notes=(f"array {key}: frames are its {'last' if is_last else 'first'} dimension",),
        )

    def _mat(self, raw: bytes) -> tuple[str, npt.NDArray[Any]]:
        """In a child: SciPy ends the process at some malformed bytes."""
        most = max(MAX_GROWN_BYTES, MAX_GROWTH * len(raw))
        plain = b"".join(_inflated(raw, most))
        arguments = self._file.name, str(most), self._file.topic or ""
        found = output_of(__name__, *arguments, n_bytes=len(plain), data=plain)
        key, _, array = found.partition(b"\n")
        return key.decode(), np.load(io.BytesIO(array), allow_pickle=False)

    def _hdf5(self) -> tuple[str, npt.NDArray[Any]]:
        try:
            import h5py
        except ImportError as error:
            raise SourceError(
                f'{self._file.name}: HDF5 needs h5py; pip install "sparseskin[hdf5]"'
            ) from error
        sizes: dict[str, int] = {}
        with h5py.File(self._file.file, "r") as file:

            def look(key: str, one: Any) -> bool | None:
                # Soft and external links are not followed.
                if isinstance(one, h5py.Dataset) and not (one.external or one.is_virtual):
                    sizes[key] = one.ndim
                return len(sizes) >= _MOST or None

            file.visititems(look)
            ends = {key.rpartition("/")[2]: key for key in sizes}
            topic = self._file.topic and self._file.topic.strip("/")
            key = frames_name(
                sizes if topic or "forces" not in ends else {ends["forces"]: 3},
                topic,
                self._file.name,
            )
            found = file[key]
            most = max(MAX_GROWN_BYTES, MAX_GROWTH * self._file.file.seek(0, 2))
            _check_size(self._file.name, key, found.size * found.dtype.itemsize, most)
            return key, found[()]


def _check_size(name: str, key: str, n_bytes: int, most: int) -> None:
    if n_bytes > most:
        raise SourceError(f"{name}, array {key}: {n_bytes} bytes; at most {most}")


def _chosen(name: str, most: int, topic: str | None) -> tuple[str, npt.NDArray[Any]]:
    """The array of a plain .mat on the standard input, and its name or path."""
    from scipy.io import loadmat, whosmat

    plain = io.BytesIO(sys.stdin.buffer.read())
    try:
        listed = whosmat(plain)
        numbers = {key: n for key, n, kind in listed if kind[:3] in ("dou", "sin", "int", "uin")}
        structs = [key for key, _, kind in listed if kind == "struct"]
        plain.seek(0)
        found = loadmat(plain, variable_names=structs) if structs else {}
        fields = dict(pair for key in structs for pair in _fields(key, found[key]))
        sizes = {key: len(shape) for key, shape in numbers.items()}
        sizes |= {key: field.ndim for key, field in fields.items()}
        key = frames_name(sizes, topic, name)
        if key in fields:
            return key, fields[key]
        _check_size(name, key, 8 * prod(numbers[key]), most)
        plain.seek(0)
        return key, loadmat(plain, variable_names=[key])[key]
    except SourceError:
        raise
    except Exception as error:  # of SciPy, at malformed bytes of any kind
        raise unreadable(name, error) from error


def main(name: str, most: str, topic: str) -> int:
    """Print name and bytes of the chosen array, or why there is none; the exit status."""

    def work() -> None:
        key, array = _chosen(name, int(most), topic or None)
        sys.stdout.buffer.write(f"{key}\n".encode())
        np.save(sys.stdout.buffer, array, allow_pickle=False)

    return child_status(name, work)


def _fields(key: str, one: npt.NDArray[Any]) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """The arrays of numbers in a structure, by their paths, as log.left.forces."""
    if one.dtype.names and one.size == 1:
        for name in one.dtype.names:
            yield from _fields(f"{key}.{name}", np.asarray(one.flat[0][name]))
    elif one.dtype.kind in "iuf":
        yield key, one


def _inflated(raw: bytes, most: int) -> Iterator[bytes]:
    """A .mat with its compressed elements in plain; SourceError beyond `most` bytes."""
    yield raw[:_HEAD]
    order, at = "<" if raw[126:128] == b"IM" else ">", _HEAD
    while at + 8 <= len(raw):
        kind, size = struct.unpack_from(f"{order}II", raw, at)
        element = raw[at : at + 8 + size]
        if kind == _COMPRESSED:
            element = zlib.decompressobj().decompress(element[8:], most + 1)
            most -= len(element)
            if most < 0:
                raise SourceError("its arrays are far larger than the file")
        yield element
        at += 8 + size


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
