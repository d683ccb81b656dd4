"""The launcher's terminal: log lines of all nodes, and a status that renews itself."""

import contextlib
import os
import re
import select
import shutil
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator

from sparseskin.messages.text import printable

from .run_log import RunLog, time_text

QUIET_STATUS_S = 10.0
"""Period of the status where the output is no terminal, seconds."""

ARROWS = {
    "\x1b[A": "up",
    "\x1b[B": "down",
    "\x1b[C": "right",
    "\x1b[D": "left",
}
"""Keys that come as three characters."""


class Terminal:
    """Writes to stderr, so that stdout holds results alone; each line of the log into the files of
    `run_log` too. `now_s` returns the time of day, seconds since the epoch.
    """

    def __init__(
        self, run_log: RunLog | None = None, now_s: Callable[[], float] = time.time
    ) -> None:
        self._run_log = run_log
        self._now_s = now_s
        # Started with stderr closed, or closed while it runs: the graph continues without output.
        self._open = sys.stderr is not None
        self._live = self._open and sys.stderr.isatty()
        self._status = ""
        self._n_drawn = 0
        self._keys_fd: int | None = None
        self._next_s = time.monotonic() + QUIET_STATUS_S

    def log(self, line: str) -> None:
        """Print one line, with its time, above the status line."""
        now_s = self._now_s()
        self._erase()
        self._write(f"{time_text(now_s)} {printable(line)}\n")
        self.record(line)
        self._draw()

    def record(self, line: str) -> None:
        """Write one line into the log files alone."""
        now_s = self._now_s()
        run_log = self._run_log
        if run_log is None or run_log.error:
            return
        run_log.write(printable(line), now_s)
        if run_log.error:
            # Once: with the error set, no later line is written.
            self._write(f"{time_text(now_s)} [launch] no more logs: {run_log.error}\n")

    def status(self, line: str) -> None:
        """Renew the status line, or lines, where the text has changed."""
        line = "\n".join(map(printable, line.split("\n")))
        if self._live and line != self._status:
            self._erase()
            self._status = line
            self._draw()
        elif not self._live and line and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + QUIET_STATUS_S
            self._write(line + "\n")

    @contextlib.contextmanager
    def keyboard(self, wanted: bool) -> Iterator[None]:
        """Read single keys from the terminal, and restore its mode at the end."""
        if not wanted or not sys.stdin.isatty():
            yield
            return
        fd = sys.stdin.fileno()
        terminal_mode = termios.tcgetattr(fd)
        # Unlike raw mode, this leaves Ctrl-C a signal and line ends as they are.
        tty.setcbreak(fd)
        self._keys_fd = fd
        try:
            yield
        finally:
            self._keys_fd = None
            termios.tcsetattr(fd, termios.TCSADRAIN, terminal_mode)

    def pressed(self) -> list[str]:
        """Keys that were pressed since the last call: characters, or "right", "up", "down"."""
        if self._keys_fd is None:
            return []
        ready, _, _ = select.select([self._keys_fd], [], [], 0)
        if not ready:
            return []
        text = os.read(self._keys_fd, 64).decode(errors="replace")
        keys = re.findall(r"\x1b\[[A-D]|.", text, re.DOTALL)
        return [ARROWS.get(key, key) for key in keys]

    def _erase(self) -> None:
        if self._live and self._status:
            # Back to the first line of the status; all from there on goes.
            up = ""
            if self._n_drawn > 1:
                up = f"\x1b[{self._n_drawn - 1}A"
            self._write(f"\r{up}\x1b[J")

    def _draw(self) -> None:
        if self._live and self._status:
            # A line that wraps, or scrolls the screen, could not be erased by its number of lines.
            size = shutil.get_terminal_size()
            status_lines = self._status.split("\n")[: size.lines - 1]
            lines = [_fitted(line, size.columns - 1) for line in status_lines]
            self._n_drawn = len(lines)
            self._write("\n".join(lines))

    def _write(self, text: str) -> None:
        if not self._open:
            return
        try:
            sys.stderr.write(text)
            sys.stderr.flush()
        except OSError:
            self._open = False


def _fitted(line: str, width: int) -> str:
    """A line without the last of its parts, between " | ", that do not fit."""
    while len(line) > width and " | " in line:
        line = line.rpartition(" | ")[0]
    return line[:width]
