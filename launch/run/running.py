"""The graphs that run on this host: each leaves a note of its endpoints while it runs.

A note is locked by the launcher that wrote it. A lock ends with its process, however that ends,
so a note that is not locked is of a graph that is gone.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.lookup import did_you_mean


class GraphError(SparseskinError):
    """No graph runs, or it is not clear which is meant."""


@dataclass(frozen=True)
class RunningNode:
    """A node of a running graph: where it publishes, and what."""

    type_name: str
    endpoint: str
    outputs: list[str]
    key: str = ""
    """Public key of the node, which its readers need; "" without keys."""


@dataclass(frozen=True)
class RunningGraph:
    """A graph that runs on this host."""

    name: str
    pid: int
    offset_ns: int
    launch: str
    nodes: dict[str, RunningNode]
    key_file: str = ""
    """File of the secret key with which programs of this user may read; "" without keys."""
    page_token: str = ""
    """Token that its live pages ask for."""

    @property
    def label(self) -> str:
        """Name by which one of several graphs is chosen."""
        return f"{self.name}-{self.pid}"

    @property
    def control(self) -> str:
        """Path of its control socket."""
        return str(notes_folder() / f"{self.pid}.sock")

    def writers(self) -> dict[str, str]:
        """Name of the node that writes each topic."""
        return {topic: name for name, node in self.nodes.items() for topic in node.outputs}


def notes_folder() -> Path:
    """Folder of the notes, which belongs to the user."""
    import tempfile  # with it come compression and random numbers, which a key press waits for

    stated = os.environ.get("SPARSESKIN_RUNTIME_DIR")
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if stated:
        folder = Path(stated)
    elif runtime and Path(runtime).is_dir():
        folder = Path(runtime) / "sparseskin"
    else:
        folder = Path(tempfile.gettempdir()) / f"sparseskin-{os.getuid()}"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise GraphError(f"{folder}: belongs to another user")
    return folder


def control_path() -> str:
    """Path of the control socket of the graph that this process launches."""
    path = notes_folder() / f"{os.getpid()}.sock"
    path.unlink(missing_ok=True)  # left by a process that had the same number
    return str(path)


@contextlib.contextmanager
def announced(graph: RunningGraph) -> Iterator[None]:
    """Leave a note of a graph for as long as the context lasts."""
    path = notes_folder() / f"{graph.label}.json"
    with path.open("w") as note:
        fcntl.flock(note, fcntl.LOCK_EX)
        json.dump(asdict(graph), note)
        note.flush()
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def running_graphs() -> list[RunningGraph]:
    """All graphs that run; notes of graphs that are gone are cleared away."""
    found = []
    for path in sorted(notes_folder().glob("*.json")):
        with contextlib.suppress(FileNotFoundError), path.open() as note:
            if not _is_locked(note):
                path.unlink(missing_ok=True)
                pid = path.stem.rpartition("-")[2]
                path.with_name(f"{pid}.sock").unlink(missing_ok=True)
                continue
            with contextlib.suppress(ValueError, TypeError, KeyError):
                found.append(_graph(json.load(note)))
    return found


def is_running(graph: RunningGraph) -> bool:
    """True if a graph still runs."""
    return any(other.label == graph.label for other in running_graphs())


def choose_graph(name: str | None) -> RunningGraph:
    """The graph of that name, label or process number, or the only one there is.
    Raises GraphError if there is none, or more than one.
    """
    graphs = running_graphs()
    if not graphs:
        raise GraphError("no graph runs on this host (start one: sparseskin launch NAME)")
    matching = [g for g in graphs if name in (None, g.name, g.label, str(g.pid))]
    labels = [graph.label for graph in graphs]
    if not matching:
        raise GraphError(f"--graph {name}: no such graph runs{did_you_mean(str(name), labels)}")
    if len(matching) > 1:
        choices = ", ".join(graph.label for graph in matching)
        raise GraphError(f"several graphs run; choose one with --graph: {choices}")
    return matching[0]


def _is_locked(note: IO[str]) -> bool:
    try:
        fcntl.flock(note, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    fcntl.flock(note, fcntl.LOCK_UN)
    return False


def _graph(fields: dict[str, Any]) -> RunningGraph:
    nodes = {name: RunningNode(**node) for name, node in fields.pop("nodes").items()}
    return RunningGraph(**fields, nodes=nodes)
