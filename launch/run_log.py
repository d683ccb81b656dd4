"""What the nodes of a run said, in files: a folder a run, a file a node, bounded in size."""

from __future__ import annotations

import os
import re
import shutil
import time
from pathlib import Path
from typing import IO

from .launchspec import LaunchError

MAX_FILE_BYTES = 2_000_000
"""A file that is full becomes NAME.log.1, in the place of the one before it."""
MAX_RUNS = 20
"""Folders of runs that are kept beside each other; the oldest go."""
LAUNCHER = "launch"
_RUN = re.compile(r".+-\d{8}-\d{6}-\d+")
_NAMED = re.compile(r"\[([A-Za-z0-9_.-]+)\] (.*)", re.DOTALL)


def default_log_dir() -> Path:
    """Where the folders of runs are, if nobody says otherwise."""
    state = os.environ.get("XDG_STATE_HOME")
    return (Path(state) if state else Path.home() / ".local" / "state") / "sparseskin" / "log"


def time_text(now_s: float) -> str:
    """Time of day with milliseconds, as it is set before each line."""
    return f"{time.strftime('%H:%M:%S', time.localtime(now_s))}.{int(now_s * 1000) % 1000:03d}"


class RunLog:
    """The files of one run.

    Parameters
    ----------
    parent : Path
        Folder of the runs; made where it is missing.
    name : str
        Name of the graph.
    now_s : float
        Time of day, in seconds since the epoch; it names the run's folder.

    Attributes
    ----------
    folder : Path
        The run's own: NAME-DATE-TIME-PROCESS.
    error : str
        Why nothing more is written, once that is so.

    Raises
    ------
    LaunchError
        If the folder cannot be made.
    """

    def __init__(self, parent: Path, name: str, now_s: float) -> None:
        date = time.strftime("%Y%m%d-%H%M%S", time.localtime(now_s))
        self.folder = parent / f"{name}-{date}-{os.getpid()}"
        self.error = ""
        self._files: dict[str, IO[str]] = {}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise LaunchError([f"log_dir: {self.folder}: {error.strerror}"]) from error
        _clear(parent)

    def write(self, line: str, now_s: float) -> None:
        """Write one line "[NAME] TEXT" into the file of that node, with date and time."""
        found = _NAMED.fullmatch(line)
        name, text = found.groups() if found else (LAUNCHER, line)
        date = time.strftime("%Y-%m-%d", time.localtime(now_s))
        try:
            file = self._file(name)
            file.write(f"{date} {time_text(now_s)} {text}\n")
            file.flush()
            if file.tell() > MAX_FILE_BYTES:
                self._files.pop(name).close()
                path = self.folder / f"{name}.log"
                path.replace(path.with_name(f"{name}.log.1"))
        except OSError as error:
            self.error = f"{self.folder}: {error.strerror}"

    def close(self) -> None:
        """Close all files."""
        for file in self._files.values():
            file.close()
        self._files.clear()

    def _file(self, name: str) -> IO[str]:
        if name not in self._files:
            path = self.folder / f"{name}.log"
            self._files[name] = path.open("a", encoding="utf-8", errors="replace")
        return self._files[name]


def _clear(parent: Path) -> None:
    """Remove the oldest runs; what is no run's folder stays."""
    runs = [path for path in parent.iterdir() if path.is_dir() and _RUN.fullmatch(path.name)]
    for path in sorted(runs, key=lambda run: run.stat().st_mtime)[:-MAX_RUNS]:
        shutil.rmtree(path, ignore_errors=True)
