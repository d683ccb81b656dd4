"""The file under a bag while it is written: whole records reach the disk, or none."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

from .bag import BagError


class BagFile:
    """A write-only stream that holds bytes back until `flush`.

    A flush that fails cuts the file back to where it began, so that what the disk holds always
    ends with a complete record, also on a full disk.
    """

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises
        ------
        OSError
            If it cannot be created, FileExistsError if it is there.
        """
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        self._pending = bytearray()
        self._written = 0

    @property
    def n_pending(self) -> int:
        """How many bytes the disk has not been given."""
        return len(self._pending)

    def write(self, data: bytes) -> int:
        """Take bytes; they stay in memory until `flush`."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Position in the file, counting what is still in memory."""
        return self._written + len(self._pending)

    def flush(self) -> None:
        """Hand everything to the operating system.

        Raises
        ------
        OSError
            If it does not take it; what was pending is then dropped.
        """
        pending, self._pending = bytes(self._pending), bytearray()
        done = 0
        try:
            while done < len(pending):
                done += os.write(self._fd, memoryview(pending)[done:])
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self._written)
            raise
        self._written += done

    def sync(self) -> None:
        """Wait until the disk holds what was flushed."""
        os.fsync(self._fd)

    def close(self) -> None:
        """Close the file; what was not flushed is dropped."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)


def place(part: Path, path: Path) -> None:
    """Give a file its name, but never in the place of another.

    Raises
    ------
    OSError
        FileExistsError where another file has the name, or what else the disk refuses.
    """
    try:
        # Unlike a rename, a link does not replace a file that came meanwhile.
        os.link(part, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from None
        part.rename(path)
    else:
        part.unlink()


def give_name(part: Path, path: Path) -> None:
    """Give a complete bag its name, and wait until the disk knows it.

    Raises
    ------
    BagError
        If another file has the name, or the disk refuses.
    """
    try:
        place(part, path)
    except OSError as error:
        raise BagError(
            f"{path}: {error.strerror}; the recording is complete in {part.name}"
        ) from error
    with contextlib.suppress(OSError):
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
