"""Waiting for processes without guessing how long, and finding those of one run."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from sparseskin.launch.run.running import RunningGraph, remove_note, write_note

PATIENCE_S = 300.0
"""When a wait is given up: far beyond what anything here takes, so it is no claim on speed."""


def wait_until(done: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> float:
    """Look again and again until something is so; the seconds that it took."""
    began_s = time.monotonic()
    while not done():
        assert time.monotonic() < began_s + patience_s, f"gave up waiting for {what}"
        time.sleep(0.01)
    return time.monotonic() - began_s


def note_of_graph(folder: Path) -> Path:
    """The note of the graph whose runtime folder this is, once the graph can be joined."""
    found: list[Path] = []

    def is_there() -> bool:
        for path in folder.glob("*.json"):
            with contextlib.suppress(ValueError, OSError):  # it is being written
                found.extend([path] if json.loads(path.read_text())["nodes"] else [])
        return bool(found)

    wait_until(is_there, "the note of the graph")
    return found[0]


@contextlib.contextmanager
def announced(graph: RunningGraph) -> Iterator[None]:
    """The note of a graph, and its control socket, where nobody answers."""
    with socket.socket(socket.AF_UNIX) as listener:
        if not os.path.lexists(graph.control):
            listener.bind(graph.control)
            listener.listen()
        write_note(graph)
        yield
        remove_note(graph)
    Path(graph.control).unlink(missing_ok=True)


def processes_with(mark: str) -> dict[int, str]:
    """Command lines of all processes with KEY=VALUE in their environment, by pid."""
    found = {}
    for folder in (path for path in Path("/proc").iterdir() if path.name.isdecimal()):
        with contextlib.suppress(OSError):
            if mark.encode() in (folder / "environ").read_bytes().split(b"\0"):
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ")
                found[int(folder.name)] = command.decode(errors="replace")
    return found
