"""The launcher's terminal: log lines of all nodes, and one status line that renews itself."""

from __future__ import annotations

import shutil
import sys
import time

QUIET_STATUS_S = 10.0
"""How often the status is printed where the output is no terminal."""


class Terminal:
    """Writes to stderr, so that stdout holds results alone."""

    def __init__(self) -> None:
        self._live = sys.stderr.isatty()
        self._status = ""
        self._next_s = time.monotonic() + QUIET_STATUS_S

    def log(self, line: str) -> None:
        """Print one line above the status line."""
        self._erase()
        print(line, file=sys.stderr, flush=True)
        self._draw()

    def status(self, line: str) -> None:
        """Renew the status line."""
        if self._live:
            self._erase()
            self._status = line
            self._draw()
        elif line and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + QUIET_STATUS_S
            print(line, file=sys.stderr, flush=True)

    def _erase(self) -> None:
        if self._live and self._status:
            sys.stderr.write("\r\x1b[K")

    def _draw(self) -> None:
        if self._live and self._status:
            width = shutil.get_terminal_size().columns - 1
            sys.stderr.write(self._status[:width])
            sys.stderr.flush()
