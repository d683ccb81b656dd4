"""Output that is there whole or not at all, and never in the place of another."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .bag import PART_SUFFIX, BagError
from .bag_file import place


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield the path to write to; the file gets its name if nothing was raised.

    Raises
    ------
    BagError
        If the file exists, or cannot be written.
    """
    part = path.with_name(path.name + PART_SUFFIX)
    check_free(path, part)
    try:
        yield part
        with os_errors(path):
            place(part, path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder to write into; it is removed if something was raised.

    Raises
    ------
    BagError
        If it exists, or cannot be made.
    """
    check_free(path)
    with os_errors(path):
        path.mkdir()
    try:
        yield path
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise


@contextmanager
def os_errors(path: Path) -> Iterator[None]:
    """Turn an OSError into a BagError that names the file."""
    try:
        yield
    except OSError as error:
        raise BagError(f"{path}: {error.strerror or error}") from error


def check_free(*paths: Path) -> None:
    """Refuse to write over anything.

    Raises
    ------
    BagError
        If one of the paths is taken, or its folder does not exist.
    """
    for path in paths:
        if os.path.lexists(path):
            raise BagError(f"{path}: is there already; nothing is overwritten")
        if not path.parent.is_dir():
            raise BagError(f"{path}: its folder does not exist")
