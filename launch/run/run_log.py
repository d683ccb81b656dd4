"""Log files of a run: a folder a run, a file a node, bounded in size."""

import contextlib
import logging
import os
import re
import shutil
import stat
import time
from logging.handlers import RotatingFileHandler
from pathlib import Path

from sparseskin.launch.launchfile.spec import LAUNCHER, LaunchError

MAX_FILE_BYTES = 2_000_000
"""Size at which a file becomes NAME.log.1, in place of the one before it, bytes."""
MAX_RUNS = 20
"""Most folders of runs that are kept beside each other; the oldest are removed."""
MARK = ".sparseskin"
"""File of a run whose text is the name of its folder: without it none is removed."""
_FILE = re.compile(r"[A-Za-z0-9_.-]+\.log(\.1)?")
_NAMED = re.compile(r"\[([A-Za-z0-9_.-]+)\] (.*)", re.DOTALL)


def time_text(now_s: float) -> str:
    """Time of day with milliseconds, which stands before each line."""
    return f"{time.strftime('%H:%M:%S', time.localtime(now_s))}.{int(now_s * 1000) % 1000:03d}"


class _NodeFile(RotatingFileHandler):
    """The file of one node; unlike its base it raises what goes wrong."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        raise


class RunLog:
    """The files of one run of the graph `name`, in a new folder NAME-DATE-TIME-PROCESS in `parent`,
    which is made where it is missing. `error` is the reason why nothing more is written; or "".
    Raises LaunchError if the folder cannot be made, or exists already.
    """

    def __init__(self, parent: Path, name: str, now_s: float) -> None:
        date = time.strftime("%Y%m%d-%H%M%S", time.localtime(now_s))
        self.folder = parent / f"{name}-{date}-{os.getpid()}"
        self.error = ""
        self._files: dict[str, _NodeFile] = {}
        try:
            # Of this user alone: the address of the live page is logged with its token.
            self.folder.mkdir(mode=0o700, parents=True)
            self._fd = os.open(self.folder, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY)
        except OSError as error:
            raise LaunchError([f"log_dir: {parent}: {error.strerror}"]) from error
        if os.fstat(self._fd).st_uid != os.geteuid():
            raise LaunchError([f"log_dir: {parent}: another user changes what is in it"])
        # Whoever may change `parent` can put a folder with links in the place of this one.
        self._opened = Path(f"/proc/self/fd/{self._fd}")
        with contextlib.suppress(OSError):  # the disk is full: the first line reports it
            (self._opened / MARK).write_text(self.folder.name)
            _clear(parent)

    def write(self, line: str, now_s: float) -> None:
        """Write one line "[NAME] TEXT" into the file of that node, with date and time."""
        found = _NAMED.fullmatch(line)
        name, text = found.groups() if found else (LAUNCHER, line)
        date = time.strftime("%Y-%m-%d", time.localtime(now_s))
        text = f"{date} {time_text(now_s)} {text}"
        try:
            if name not in self._files:
                path = self._opened / f"{name}.log"
                self._files[name] = _NodeFile(
                    path, maxBytes=MAX_FILE_BYTES, backupCount=1, encoding="utf-8", errors="replace"
                )
            self._files[name].emit(logging.makeLogRecord({"msg": text}))
        except OSError as error:
            self.error = f"{self.folder}: {error.strerror}"

    def close(self) -> None:
        """Close all files; nothing more can be written."""
        for file in self._files.values():
            with contextlib.suppress(OSError):  # the disk is full
                file.close()
        self._files.clear()
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _clear(parent: Path) -> None:
    """Remove the oldest runs; of one that a link has replaced meanwhile, nothing."""
    runs = sorted(filter(_is_run, parent.iterdir()), key=lambda run: run.lstat().st_mtime)
    for run in runs[:-MAX_RUNS]:
        shutil.rmtree(run, ignore_errors=True)


def _is_run(path: Path) -> bool:
    """True if a folder is that of a run, of this user, and nothing else is in it."""
    with contextlib.suppress(OSError, UnicodeDecodeError):
        found = path.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid():
            names = set(os.listdir(path))
            own = all(_FILE.fullmatch(name) for name in names - {MARK})
            return own and (path / MARK).read_text(encoding="utf-8") == path.name
    return False
