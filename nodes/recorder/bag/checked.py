"""Files of which the checksum of the whole has matched in this process."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextvars import ContextVar
from typing import BinaryIO

_TRUSTS: ContextVar[bool] = ContextVar("trusts", default=False)
_MATCHED: set[tuple[int, ...]] = set()
_MOST = 1024


@contextlib.contextmanager
def checked_once() -> Iterator[None]:
    """In this context a file whose checksum has matched is not read whole again when it is opened
    again, unless its size or the time of its last change differ.

    Chunks are checked each time they are read, as always.
    """
    token = _TRUSTS.set(True)
    try:
        yield
    finally:
        _TRUSTS.reset(token)


def is_checked(file: BinaryIO) -> bool:
    """True if the checksum of an open file need not be computed."""
    return _TRUSTS.get() and _identity(file) in _MATCHED


def note_checked(file: BinaryIO) -> None:
    """Note that the checksum of an open file has matched."""
    if _TRUSTS.get() and len(_MATCHED) < _MOST:
        _MATCHED.add(_identity(file))


def _identity(file: BinaryIO) -> tuple[int, ...]:
    found = os.fstat(file.fileno())
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns
