"""Log files of a run: a folder a run, a file a node, bounded in size."""

import contextlib
import logging
import os
import re
import shutil
import time
from logging.handlers import RotatingFileHandler
from pathlib import Path

from sparseskin.launch.launchfile.spec import LAUNCHER, LaunchError

MAX_FILE_BYTES = 2_000_000
"""Size at which a file becomes NAME.log.1, in place of the one before it, bytes."""
MAX_RUNS = 20
"""Folders of runs that are kept in the default folder; the oldest are removed."""
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
    which is made where it is missing; of the runs there the newest `n_kept` stay, 0: all. `error`
    is the reason why nothing more is written; or "".
    Raises LaunchError if the folder cannot be made, or exists already.
    """

    def __init__(self, parent: Path, name: str, now_s: float, n_kept: int = 0) -> None:
        date = time.strftime("%Y%m%d-%H%M%S", time.localtime(now_s))
        self.folder = parent / f"{name}-{date}-{os.getpid()}"
        self.error = ""
        self._files: dict[str, _NodeFile] = {}
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY
        try:
            # Of this user alone: the address of the live page is logged with its token.
            self.folder.mkdir(mode=0o700, parents=True)
            self._fd = os.open(self.folder, flags)
        except OSError as error:
            raise LaunchError([f"log_dir: {parent}: {error.strerror}"]) from error
        if os.fstat(self._fd).st_uid != os.geteuid():
            raise LaunchError(
                [f"log_dir: {parent}: another user changes what is in it"]
            )
        # Whoever may change `parent` can put a folder with links in the place of this one.
        self._opened = Path(f"/proc/self/fd/{self._fd}")
        if n_kept:
            _remove_old_runs(parent, n_kept)

    def write(self, line: str, now_s: float) -> None:
        """Write one line "[NAME] TEXT" into the file of that node, with date and time."""
        prefix = _NAMED.fullmatch(line)
        name = LAUNCHER
        text = line
        if prefix is not None:
            name, text = prefix.groups()
        # A run may go on over midnight: unlike the terminal, each line has its date.
        date = time.strftime("%Y-%m-%d", time.localtime(now_s))
        text = f"{date} {time_text(now_s)} {text}"
        try:
            if name not in self._files:
                path = self._opened / f"{name}.log"
                self._files[name] = _NodeFile(
                    path,
                    maxBytes=MAX_FILE_BYTES,
                    backupCount=1,
                    encoding="utf-8",
                    errors="replace",
                )
            self._files[name].emit(logging.makeLogRecord({"msg": text}))
        except OSError as error:
            self.error = f"{self.folder}: {error.strerror}"

    def close(self) -> None:
        """Close all files; nothing more can be written."""
        for file in self._files.values():
            # The rest of a file cannot be written where the disk is full.
            with contextlib.suppress(OSError):
                file.close()
        self._files.clear()
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _remove_old_runs(parent: Path, n_kept: int) -> None:
    # Another launcher may remove the same folders.
    with contextlib.suppress(OSError):
        # A link is not followed: it may lead anywhere.
        runs = sorted(parent.iterdir(), key=lambda run: run.lstat().st_mtime)
        n_surplus = max(0, len(runs) - n_kept)
        for run in runs[:n_surplus]:
            shutil.rmtree(run, ignore_errors=True)
