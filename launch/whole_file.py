"""Files that appear under their name whole, or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.recorder.bag_file import place


class OutputError(SparseskinError):
    """A file that cannot be written where it was asked for."""


def check_writable(path: Path) -> None:
    """Find out before a run, not after it, that its summary cannot be written.

    Raises
    ------
    OutputError
        If the path is a folder, or its folder does not exist or cannot be written to.
    """
    folder = path.resolve().parent
    if path.is_dir():
        raise OutputError(f"--summary {path}: is a folder")
    if not folder.is_dir():
        raise OutputError(f"--summary {path}: its folder does not exist")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise OutputError(f"--summary {path}: cannot be written to")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a path of the same name in a folder of its own beside `path`; what was written there
    gets its place when nothing was raised, and is removed otherwise.

    Raises
    ------
    OutputError
        If the folder does not exist or cannot be written to, or `path` is taken: a file is never
        written over.
    """
    if os.path.lexists(path):
        raise OutputError(f"{path}: exists already, and is not written over")
    try:
        folder = tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise OutputError(f"{path}: {_reason(error)}") from error
    with folder as name:
        draft = Path(name) / path.name
        yield draft
        if not draft.exists():
            return
        try:
            place(draft, path)
        except OSError as error:
            raise OutputError(f"{path}: {_reason(error)}") from error


def _reason(error: OSError) -> str:
    if isinstance(error, FileNotFoundError):
        return "its folder does not exist"
    if isinstance(error, FileExistsError):
        return "exists already, and is not written over"
    return error.strerror or str(error)
