"""Arrays of .npy and .npz files from elsewhere: their sizes are checked before memory is used."""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from collections.abc import Callable
from typing import IO, Any

import numpy as np
import numpy.typing as npt

MAX_GROWTH = 100
"""Size of the arrays of an .npz in that of the file; zeros are compressed to a thousandth."""
MAX_GROWN_BYTES = 1 << 30
"""Size of the arrays of an .npz up to which their growth does not matter, bytes."""
MAX_HEAD_BYTES = 1 << 17
"""Longest header of an .npy, bytes; that of NumPy is a hundred."""
_NPY, _ZIP = b"\x93NUMPY", b"PK"


class ArrayFileError(ValueError):
    """Bytes that are no such file, or state more than they hold."""


def is_npz(raw: bytes) -> bool:
    """True if the bytes begin as an archive does."""
    return raw.startswith(_ZIP)


def read_npy(raw: bytes) -> npt.NDArray[np.generic]:
    """The array of an .npy, a view of its bytes. Raises ArrayFileError if it is none of numbers."""
    head = io.BytesIO(raw[:MAX_HEAD_BYTES])
    shape, in_columns, dtype = _header(head)
    held = len(raw) - head.tell()
    _check_size(shape, dtype, held)
    flat = np.frombuffer(raw, dtype, offset=head.tell()) if held else np.empty(0, dtype)
    try:
        return flat.reshape(shape, order="F" if in_columns else "C")
    except ValueError as error:  # no number, in sides that no index counts
        raise ArrayFileError(f"its header states {_shape(shape)}") from error


def npy_shape(file: IO[bytes]) -> tuple[int, ...]:
    """The shape that the header of an .npy states, of which no more is read.
    Raises ArrayFileError if it is none.
    """
    return _header(io.BytesIO(file.read(MAX_HEAD_BYTES)))[0]


def npz_shapes(
    file: IO[bytes], wanted: Callable[[list[str]], list[str]]
) -> dict[str, tuple[int, ...]]:
    """The shapes of those arrays of an .npz that `wanted` chooses of their names; no more than
    their headers is read.
    Raises ArrayFileError if it is no archive, or one of them is no .npy.
    """
    found = {}
    try:
        with zipfile.ZipFile(file) as archive:
            members = _members(archive)
            for name in wanted(list(members)):
                with archive.open(members[name]) as one:
                    found[name] = npy_shape(one)
    except Exception as error:  # as in `read_npz`
        raise ArrayFileError("not a readable NumPy file") from error
    return found


def npz_member(file: IO[bytes], name: str, most_bytes: int) -> npt.NDArray[np.generic]:
    """One array of an .npz.
    Raises ArrayFileError as `read_npz` does.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            member = _members(archive)[name]
            if member.file_size > most_bytes:
                text = f"array {ascii(name)[:40]}: it would have {member.file_size} bytes"
                raise ArrayFileError(f"{text}; at most {most_bytes}")
            return _member(archive, member, name)
    except ArrayFileError:
        raise
    except Exception as error:  # as in `read_npz`
        raise ArrayFileError("not a readable NumPy file") from error


def read_npz(
    raw: bytes, wanted: Callable[[list[str]], list[str]], most_bytes: int | None = None
) -> dict[str, npt.NDArray[np.generic]]:
    """Those arrays of an .npz that `wanted` chooses of their names.

    Raises ArrayFileError if it is no archive, such an array cannot be read, or they are larger
    together than `most_bytes`; by default `MAX_GROWN_BYTES` or `MAX_GROWTH` times the file.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            members = _members(archive)
            names = wanted(list(members))
            size = sum(members[name].file_size for name in names)
            most = most_bytes or max(MAX_GROWN_BYTES, MAX_GROWTH * len(raw))
            if size > most:
                raise ArrayFileError(
                    f"its arrays would have {size} bytes, of a file of {len(raw)}; at most {most}"
                )
            return {name: _member(archive, members[name], name) for name in names}
    except ArrayFileError:
        raise
    except Exception as error:  # zipfile and zlib have as many
        raise ArrayFileError("not a readable NumPy file") from error


def _header(head: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and dtype of the header of an .npy; True for an order by columns."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            version = np.lib.format.read_magic(head)
            if version == (1, 0):
                return np.lib.format.read_array_header_1_0(head)
            return np.lib.format.read_array_header_2_0(head)
    # NumPy and its parser of Python's literals raise ten kinds of error at malformed bytes.
    except Exception as error:
        raise ArrayFileError("not a readable NumPy file") from error


def _check_size(shape: tuple[int, ...], dtype: np.dtype[Any], held: int) -> None:
    """Raise ArrayFileError unless so many bytes hold an array of numbers of that shape."""
    if dtype.hasobject:
        raise ArrayFileError("it holds Python objects; allowed are arrays of numbers")
    stated = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or stated != held or not dtype.itemsize:
        text = f"{_shape(shape)} of {str(dtype)[:40]}, but {held} bytes follow"
        raise ArrayFileError(f"its header states {text}")


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """The arrays of an .npz by name."""
    return {one.filename.removesuffix(".npy"): one for one in archive.infolist()}


def _check_compression(member: zipfile.ZipInfo) -> None:
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ArrayFileError("compressed in a way that NumPy does not write")


def _member(
    archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str
) -> npt.NDArray[np.generic]:
    try:
        _check_compression(member)
        return read_npy(archive.read(member))
    except Exception as error:
        why = str(error) if isinstance(error, ArrayFileError) else "not a readable NumPy file"
        raise ArrayFileError(f"array {ascii(name)[:40]}: {why}") from error


def _shape(shape: tuple[int, ...]) -> str:
    return " x ".join(str(side) if side < 1 << 40 else "2**40.." for side in shape[:8]) or "one"
