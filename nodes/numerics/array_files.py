"""Arrays of .npy and .npz files from elsewhere: their sizes are checked before memory is used."""

import io
import math
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, Any, NamedTuple

import numpy as np

from .arrays import AnyArray

MAX_GROWTH = 100
"""Size of the arrays of an .npz in that of the file; zeros are compressed to a thousandth."""
MAX_GROWN_BYTES = 1 << 30
"""Size of the arrays of an .npz up to which their growth does not matter, bytes."""
MAX_HEAD_BYTES = 1 << 17
"""Longest header of an .npy, bytes; that of NumPy is a hundred."""
_ZIP = b"PK"
_UNREADABLE = "not a readable NumPy file"


class ArrayFileError(ValueError):
    """Bytes that are no such file, or state more than they hold."""


def is_npz(raw: bytes) -> bool:
    """True if the bytes begin as an archive does."""
    return raw.startswith(_ZIP)


def read_npy(raw: bytes) -> AnyArray:
    """The array of an .npy, a view of its bytes. Raises ArrayFileError if it is none of numbers."""
    head = io.BytesIO(raw[:MAX_HEAD_BYTES])
    shape, in_columns, dtype = _header(head)
    n_bytes = len(raw) - head.tell()
    _check_size(shape, dtype, n_bytes)
    # NumPy refuses a view of no bytes.
    flat: AnyArray = np.empty(0, dtype)
    if n_bytes:
        flat = np.frombuffer(raw, dtype, offset=head.tell())
    try:
        return flat.reshape(shape, order="F" if in_columns else "C")
    # No number, in sides that no index counts.
    except ValueError as error:
        raise ArrayFileError(f"its header states {_shape(shape)}") from error


class NpyHeader(NamedTuple):
    """What the header of an .npy states, and the place of the first number."""

    shape: tuple[int, ...]
    by_columns: bool
    dtype: np.dtype[Any]
    offset: int


def npy_header(file: IO[bytes], n_bytes: int) -> NpyHeader:
    """The header of an .npy of `n_bytes`, of which no more is read. Raises ArrayFileError if it is
    none, or states another size; arrays of Python objects state none.
    """
    head = io.BytesIO(file.read(MAX_HEAD_BYTES))
    shape, by_columns, dtype = _header(head)
    if not dtype.hasobject:
        _check_size(shape, dtype, n_bytes - head.tell())
    return NpyHeader(shape, by_columns, dtype, head.tell())


def read_npz(
    file: bytes | IO[bytes],
    wanted: Callable[[list[str]], list[str]],
    most_bytes: int | None = None,
) -> dict[str, AnyArray]:
    """Those arrays of an .npz that `wanted` chooses of their names.

    Raises ArrayFileError if it is no archive, such an array cannot be read, or they are larger
    together than `most_bytes`; by default `MAX_GROWN_BYTES` or `MAX_GROWTH` times the file.
    """
    file = io.BytesIO(file) if isinstance(file, bytes) else file
    with opened_npz(file) as (archive, members):
        names = wanted(list(members))
        n_bytes = file.seek(0, io.SEEK_END)
        size = sum(members[name].file_size for name in names)
        limit = most_bytes or max(MAX_GROWN_BYTES, MAX_GROWTH * n_bytes)
        if size > limit:
            raise ArrayFileError(
                f"its arrays would have {size} bytes, of a file of {n_bytes}; at most "
                f"{limit}"
            )
        return {name: _member(archive, members[name], name) for name in names}


@contextmanager
def opened_npz(
    file: IO[bytes],
) -> Iterator[tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo]]]:
    """An archive and its arrays by name; ArrayFileError for all that fails while it is open."""
    try:
        with zipfile.ZipFile(file) as archive:
            members = {}
            for member in archive.infolist():
                name = member.filename.removesuffix(".npy")
                members[name] = member
            yield archive, members
    except ArrayFileError:
        raise
    # zipfile and zlib raise ten kinds of error at malformed bytes.
    except Exception as error:
        raise ArrayFileError(_UNREADABLE) from error


def _header(head: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and dtype of the header of an .npy; True for an order by columns."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            form = np.lib.format
            if form.read_magic(head) == (1, 0):
                header = form.read_array_header_1_0(head)
            else:
                header = form.read_array_header_2_0(head)
        if any(isinstance(side, bool) for side in header[0]):
            raise ValueError("True is no length")
        return header
    # NumPy and its parser of Python's literals raise ten kinds of error at malformed bytes.
    except Exception as error:
        raise ArrayFileError(_UNREADABLE) from error


def _check_size(shape: tuple[int, ...], dtype: np.dtype[Any], held: int) -> None:
    """Raise ArrayFileError unless so many bytes hold an array of numbers of that shape."""
    if dtype.hasobject:
        raise ArrayFileError("it holds Python objects; allowed are arrays of numbers")
    stated = math.prod(shape) * dtype.itemsize
    is_negative = min(shape, default=0) < 0
    # Numbers of no bytes would be as many as the header states.
    if is_negative or stated != held or not dtype.itemsize:
        raise ArrayFileError(
            f"its header states {_shape(shape)} of {str(dtype)[:40]}, but {held} bytes "
            "follow"
        )


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str) -> AnyArray:
    place = f"array {ascii(name)[:40]}"
    try:
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ArrayFileError("compressed in a way that NumPy does not write")
        return read_npy(archive.read(member))
    except ArrayFileError as error:
        raise ArrayFileError(f"{place}: {error}") from error
    except Exception as error:
        raise ArrayFileError(f"{place}: {_UNREADABLE}") from error


def _shape(shape: tuple[int, ...]) -> str:
    # A header may state any number of sides, of any size: the text is bounded.
    sides = []
    for side in shape[:8]:
        text = "2**40.."
        if side < 1 << 40:
            text = str(side)
        sides.append(text)
    return " x ".join(sides) or "one"
