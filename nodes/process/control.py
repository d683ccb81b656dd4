"""Control channel between a node process and its launcher: one JSON object a line.

Commands arrive on stdin, events leave on stdout; everything else that the process prints goes to
stderr.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from typing import Any, TextIO

PARENT_CHECK_S = 1.0
MAX_DEPTH = 4
"""Largest depth of nested lists and maps in a request."""
COUNTED = ("received", "lost", "skipped")
"""Counters of each input in a heartbeat: messages received, lost, and received but skipped."""


def is_shallow(value: Any, depth: int = MAX_DEPTH) -> bool:
    """True if a JSON value nests lists and maps at most `depth` deep."""
    if not isinstance(value, dict | list):
        return True
    parts = value.values() if isinstance(value, dict) else value
    return depth > 0 and all(is_shallow(part, depth - 1) for part in parts)


def watch_parent() -> None:
    """End this process when its parent ends, even if a driver blocks the main thread."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_CHECK_S)
        time.sleep(PARENT_CHECK_S)  # the main thread notices first, and ends in order
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="watch-parent").start()


class Control:
    """The node's side of the channel. The end of stdin means that the launcher has ended."""

    def __init__(self) -> None:
        # Prints of a driver must not mix with events: stdout becomes stderr for all others.
        self._events: TextIO = os.fdopen(os.dup(1), "w", buffering=1)
        os.dup2(2, 1)
        sys.stdout = sys.stderr
        self.fd = sys.stdin.fileno()
        os.set_blocking(self.fd, False)
        self.closed = False
        self._rest = b""
        self._lock = threading.Lock()

    def emit(self, event: str, **fields: Any) -> None:
        """Send an event; a launcher that has ended is noticed on stdin."""
        line = json.dumps({"event": event, **fields}) + "\n"
        try:
            with self._lock:  # a node may have threads of its own
                self._events.write(line)
                self._events.flush()
        except BrokenPipeError:
            self.closed = True

    def commands(self) -> list[dict[str, Any]]:
        """Waiting commands, oldest first; sets `closed` if stdin has ended."""
        try:
            while chunk := os.read(self.fd, 65536):
                self._rest += chunk
            self.closed = True
        except BlockingIOError:
            pass
        *lines, self._rest = self._rest.split(b"\n")
        return [json.loads(line) for line in lines if line]
