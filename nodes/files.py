"""Files and folders that appear under their name complete or not at all, and replace no others."""

import contextlib
import errno
import os
import shutil
import socket
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import SparseskinError

TAKEN = "exists already, and is not written over"
NO_FOLDER = "its folder does not exist"
NO_WRITING = "cannot be written to"


class OutputError(SparseskinError):
    """A file that cannot be written where it was asked for."""


def state_folder() -> Path:
    """Folder of this program for the state of the user: in $XDG_STATE_HOME, or in the home
    directory where that is not an absolute path.
    Raises SparseskinError if no home directory is known.
    """
    # The XDG Base Directory Specification has a relative path ignored.
    folder = Path(os.environ.get("XDG_STATE_HOME", ""))
    if not folder.is_absolute():
        try:
            folder = Path.home() / ".local" / "state"
        except RuntimeError as error:
            raise SparseskinError(
                "no home directory is known; set XDG_STATE_HOME"
            ) from error
    return folder / "sparseskin"


def check_private(folder: Path) -> None:
    """Check that no other user can enter a folder or has put a link in its place.
    Raises SparseskinError if it is no folder, belongs to another user, or its mode is not 0700.
    """
    # Not `stat`: it would follow a link to a folder of the user's own.
    try:
        status = folder.lstat()
    except OSError as error:
        raise SparseskinError(f"{folder}: {error.strerror}") from error
    if stat.S_ISLNK(status.st_mode):
        fault = "is a link"
    elif not stat.S_ISDIR(status.st_mode):
        fault = "is no folder"
    elif status.st_uid != os.geteuid():
        fault = f"belongs to user {status.st_uid}"
    elif status.st_mode & 0o077:
        fault = f"mode {stat.S_IMODE(status.st_mode):04o} lets other users in"
    else:
        return
    raise SparseskinError(
        f"{folder}: {fault} (allowed: a folder of your own with mode 0700)"
    )


def is_served(path: Path) -> bool:
    """True if a process listens to the socket at a path, or might."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except (FileNotFoundError, ConnectionRefusedError):
            return False
        # One that is busy, or that this user may not enter: it is not to be replaced.
        except OSError:
            return True
    return True


def check_link(path: Path) -> None:
    """Check that a path is no link of another user, who could choose which file is written.
    Raises OSError.
    """
    with contextlib.suppress(FileNotFoundError):
        status = path.lstat()
        trusted_users = (0, os.geteuid())
        if stat.S_ISLNK(status.st_mode) and status.st_uid not in trusted_users:
            raise OSError(errno.EPERM, f"is a link of user {status.st_uid}")


def overwrite(path: Path, data: bytes) -> None:
    """Write a file in place of what it held, if `check_link` allows it. Raises OSError."""
    check_link(path)
    path.write_bytes(data)


def place(part: Path, path: Path) -> None:
    """Rename a complete file, but never over another one: FileExistsError if `path` exists."""
    try:
        # Unlike a rename, a link does not replace a file that was created meanwhile.
        os.link(part, path)
    except FileExistsError:
        raise
    # A file system without hard links.
    except OSError:
        if os.path.lexists(path):
            text = os.strerror(errno.EEXIST)
            raise FileExistsError(errno.EEXIST, text) from None
        part.rename(path)
    else:
        part.unlink()


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a path of the same name in a new folder beside `path`.

    The file written there is moved to `path` unless an exception is raised; the folder is removed.
    OutputError if `path` exists, or its folder does not or cannot be written to.
    """
    if os.path.lexists(path):
        raise OutputError(f"{path}: {TAKEN}")
    # Beside it, on the same file system: a file cannot be renamed to another one.
    with os_errors(path):
        folder = tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent)
    with folder as name:
        draft = Path(name) / path.name
        yield draft
        if draft.exists():
            with os_errors(path):
                place(draft, path)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder to write into; it is removed if an exception is raised.

    OutputError if it exists, or it or a file in it cannot be written.
    """
    with os_errors(path):
        path.mkdir()
        try:
            yield path
        # Ctrl-C, too.
        except BaseException:
            shutil.rmtree(path, ignore_errors=True)
            raise


@contextmanager
def os_errors(path: Path) -> Iterator[None]:
    """Turn an OSError into an OutputError that names the file."""
    try:
        yield
    except FileNotFoundError as error:
        raise OutputError(f"{path}: {NO_FOLDER}") from error
    except FileExistsError as error:
        raise OutputError(f"{path}: {TAKEN}") from error
    except OSError as error:
        raise OutputError(f"{path}: {error.strerror or error}") from error
