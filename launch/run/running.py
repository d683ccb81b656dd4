"""The graphs that run on this host: notes and sockets in the runtime folder of the user.

A launcher leaves a note of its graph while it runs, and locks it. A lock ends with its process,
however that ends, so a note that is not locked is of a graph that is gone: it and the sockets
and pages of that process are removed. Whoever makes, locks or removes a note holds the lock of the
folder.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import re
import stat
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.files import check_private, is_served
from sparseskin.nodes.lookup import did_you_mean

MAX_SOCKET_PATH_BYTES = 107
"""Longest path of a socket: sun_path of unix(7), less its end."""
PART = ".part"
"""Ending of the name of a note that is being made."""
MAX_NOTE_BYTES = 1 << 24
PATIENCE_S = 30.0
"""Longest time that a command waits for a graph that is starting, seconds."""
POLL_S = 0.1
_NO_NOTE = (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError)
_ELSEWHERE = "; SPARSESKIN_RUNTIME_DIR names another"


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
    """A graph that runs on this host; it has no nodes while it starts, and where it has joined
    another one.
    """

    name: str
    pid: int
    offset_ns: int
    launch: str
    nodes: dict[str, RunningNode]
    key_file: str = ""
    """File of the secret key with which programs of this user may read; "" without keys."""
    page_token: str = ""
    """Token that its live pages ask for."""
    starting: bool = False
    """True until it can be joined."""

    @property
    def label(self) -> str:
        """Name by which one of several graphs is chosen."""
        return f"{self.name}-{self.pid}"

    @property
    def control(self) -> str:
        """Path of its control socket."""
        return str(runtime_folder() / f"{self.pid}.sock")

    def writers(self) -> dict[str, str]:
        """Name of the node that writes each topic."""
        return {topic: name for name, node in self.nodes.items() for topic in node.outputs}


def runtime_folder() -> Path:
    """Folder of notes and sockets, which no other user may enter.
    Raises GraphError if it is not private, or cannot be made.
    """
    import tempfile  # with it come compression and random numbers, which a key press waits for

    stated = os.environ.get("SPARSESKIN_RUNTIME_DIR")
    runtime = Path(os.environ.get("XDG_RUNTIME_DIR") or "/nowhere")
    if stated:
        folder = Path(stated).absolute()
    elif runtime.is_dir() and runtime.stat().st_uid == os.geteuid():
        folder = runtime / "sparseskin"
    else:
        folder = Path(tempfile.gettempdir()) / f"sparseskin-{os.geteuid()}"
    try:
        if not folder.is_symlink():
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        check_private(folder)
    except OSError as error:
        raise GraphError(f"{folder}: {error.strerror}{_ELSEWHERE}") from error
    except SparseskinError as error:
        raise GraphError(f"{error}{_ELSEWHERE}") from error
    return folder


def control_path() -> str:
    """Path of the control socket of the graph that this process launches."""
    return str(runtime_folder() / f"{os.getpid()}.sock")


def socket_path(number: int) -> str:
    """Path of the socket of a node, by its number: a name would make it too long."""
    return str(runtime_folder() / f"{os.getpid()}.{number}.sock")


def page_path(number: int) -> str:
    """Path of the file with which a node opens its live page in a browser."""
    return str(runtime_folder() / f"{os.getpid()}.{number}.html")


class Note:
    """The note of a graph of this process, locked from its creation on.

    Raises GraphError if the paths of the sockets in the folder are too long, or a process of
    another container has the same number.
    """

    def __init__(self, graph: RunningGraph) -> None:
        if len(os.fsencode(socket_path(10**4))) > MAX_SOCKET_PATH_BYTES:
            raise GraphError(f"{runtime_folder()}: too long for the path of a socket{_ELSEWHERE}")
        self._path, self._size = runtime_folder() / f"{graph.label}.json", 0
        with _locked(self._path.parent):
            running = _remove_stale()
            for other in running:
                if other.pid == graph.pid:
                    folder = self._path.parent
                    raise GraphError(f"{folder}: {other.label} has this number too{_ELSEWHERE}")
            try:
                part = self._path.with_name(f"{graph.pid}{PART}")
                part.unlink(missing_ok=True)  # left by a process that had the same number
                flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
                self._file = os.fdopen(os.open(part, flags, 0o600), "w")
                fcntl.flock(self._file, fcntl.LOCK_EX)
                self._write(graph)
                part.rename(self._path)
            except OSError as error:
                raise GraphError(f"{self._path}: {error.strerror}") from error

    def announce(self, graph: RunningGraph) -> None:
        """Replace the text of the note: a graph with nodes can be joined."""
        try:
            with _locked(self._path.parent):
                self._write(graph)
        except OSError as error:
            raise GraphError(f"{self._path}: {error.strerror}") from error

    def _write(self, graph: RunningGraph) -> None:
        """Write the text in one go, over all of the last one: a process that is killed meanwhile
        leaves the one or the other.
        """
        text = json.dumps(asdict(graph)).encode()
        self._size = max(self._size, len(text))
        if os.pwrite(self._file.fileno(), text.ljust(self._size), 0) < self._size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def remove(self) -> None:
        """Remove the note, and the sockets and pages that nodes which were killed have left."""
        with _locked(self._path.parent):
            if _remove_of(self._path.parent, self._path.stem.rpartition("-")[2]):
                self._path.unlink(missing_ok=True)
            self._file.close()


@contextlib.contextmanager
def announced(graph: RunningGraph) -> Iterator[Note]:
    """Leave a note of a graph for as long as the context lasts."""
    note = Note(graph)
    try:
        yield note
    finally:
        note.remove()


def running_graphs(starting: bool = False) -> list[RunningGraph]:
    """All graphs that run and can be joined, and with `starting` those that are starting; what
    graphs that are gone have left is removed.
    """
    with _locked(runtime_folder()):
        return [one for one in _remove_stale() if one.nodes or (starting and one.starting)]


def is_running(graph: RunningGraph) -> bool:
    """True if a graph still runs."""
    try:
        folder = runtime_folder()
        with _locked(folder), _open(folder / f"{graph.label}.json") as note:
            return _is_locked(note) and bool(_graph(note).nodes)
    except FileNotFoundError:
        return False
    except OSError:  # no descriptor is free
        return True


def wait_for_end(graph: RunningGraph) -> None:
    """Wait until the launcher of a graph has ended, and with it its nodes."""
    with (
        contextlib.suppress(FileNotFoundError),
        _open(runtime_folder() / f"{graph.label}.json") as note,
    ):
        fcntl.flock(note, fcntl.LOCK_SH)


def choose_graph(name: str | None, option: str = "--graph") -> RunningGraph:
    """The graph of that name, label or process number, stated with an option, or the only one; one
    that is starting is waited for, `PATIENCE_S` at most.
    Raises GraphError if there is none, or more than one.
    """
    graphs = _wait_for_start(name)
    if not graphs:
        raise GraphError("no graph runs on this host (start one: sparseskin launch NAME)")
    matching = _named(graphs, name)
    labels = [graph.label for graph in graphs]
    if not matching:
        hint = did_you_mean(str(name), labels)
        raise GraphError(f"{option} {name}: no such graph runs{hint}".strip())
    if len(matching) > 1:
        choices = ", ".join(graph.label for graph in matching)
        which = f" with {option}" if option else ""
        raise GraphError(f"several graphs run; choose one{which}: {choices}")
    return matching[0]


def _named(graphs: list[RunningGraph], name: str | None) -> list[RunningGraph]:
    return [g for g in graphs if name in (None, g.name, g.label, str(g.pid))]


def _wait_for_start(name: str | None) -> list[RunningGraph]:
    """The running graphs, once one of them has that name or none of those that start has it."""
    given_up_s = None
    while True:
        found = running_graphs(starting=True)
        matching = _named(found, name)
        if not matching or any(graph.nodes for graph in matching):
            return [graph for graph in found if graph.nodes]
        label, now_s = matching[0].label, time.monotonic()
        if given_up_s is None:
            given_up_s = now_s + PATIENCE_S
            print(f"{label}: is starting; waiting until it runs", file=sys.stderr, flush=True)
        elif now_s >= given_up_s:
            raise GraphError(
                f"{label}: is still starting after {PATIENCE_S:g} s; its terminal shows what it "
                "waits for"
            )
        time.sleep(POLL_S)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def _remove_stale() -> list[RunningGraph]:
    """Remove what graphs that are gone have left; the graphs that run."""
    folder, found = runtime_folder(), []
    for path in sorted(folder.glob("*.json")):
        with contextlib.suppress(*_NO_NOTE), _open(path) as note:
            graph = _graph(note)
            if graph.label != path.stem or not isinstance(graph.pid, int):
                continue  # not written by this program
            if _is_locked(note):
                found.append(graph)
            elif _remove_of(folder, str(graph.pid)):
                path.unlink(missing_ok=True)
    # A node that was still starting as its launcher was killed makes files after the note is gone.
    noted = {path.stem.rpartition("-")[2] for path in folder.glob("*.json")}
    with contextlib.suppress(OSError):
        for number in {path.name.partition(".")[0] for path in folder.iterdir()} - noted:
            if number.isdecimal() and not os.path.exists(f"/proc/{number}"):
                _remove_of(folder, number)
    return found


def _remove_of(folder: Path, number: str) -> bool:
    """Remove the sockets, the pages and the part of a note of a process; False if somebody listens
    to one of the sockets.
    """
    made = re.compile(rf"{number}(\.\d+)?\.sock|{number}(\.\d+\.html|{PART})")
    served = False
    for path in folder.glob(f"{number}.*"):
        with contextlib.suppress(FileNotFoundError):  # its process ends
            is_socket, mode = path.suffix == ".sock", path.lstat().st_mode
            if made.fullmatch(path.name) and (stat.S_ISSOCK if is_socket else stat.S_ISREG)(mode):
                if is_socket and is_served(path):
                    served = True
                else:
                    path.unlink()
    return not served


def _open(path: Path) -> IO[str]:
    """Open a regular file of this user; whatever else has its name raises ValueError."""
    fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    file = os.fdopen(fd)
    found = os.fstat(fd)
    if not stat.S_ISREG(found.st_mode) or found.st_uid != os.geteuid():
        file.close()
        raise ValueError(f"{path}: is no note")
    return file


def _is_locked(note: IO[str]) -> bool:
    try:
        fcntl.flock(note, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    fcntl.flock(note, fcntl.LOCK_UN)
    return False


def _graph(note: IO[str]) -> RunningGraph:
    """The graph that a note describes; any of `_NO_NOTE` if it describes none."""
    fields: dict[str, Any] = json.loads(note.read(MAX_NOTE_BYTES))
    nodes = {name: RunningNode(**node) for name, node in fields.pop("nodes").items()}
    return RunningGraph(**fields, nodes=nodes)
