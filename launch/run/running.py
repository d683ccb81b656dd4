"""The graphs that run on this host: notes and sockets in the runtime folder of the user.

A launcher listens at its control socket while it runs, and leaves a note of its graph beside it. A
note without a listener is of a graph that is gone: it and the sockets and pages of that process are
removed.
"""

import contextlib
import json
import os
import re
import stat
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.files import check_private, is_served
from sparseskin.nodes.lookup import did_you_mean

MAX_FOLDER_BYTES = 88
"""Longest path of the runtime folder: sun_path of unix(7) has 107, less the name of a socket."""
PART = ".part"
"""Ending of the name of a note that is being written."""
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
    """A graph that runs on this host; it has no nodes while it starts."""

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
        return control_path(self.pid)

    @property
    def starting(self) -> bool:
        """True until it can be joined."""
        return not self.nodes

    def writers(self) -> dict[str, str]:
        """Name of the node that writes each topic."""
        writers: dict[str, str] = {}
        for name, node in self.nodes.items():
            writers |= dict.fromkeys(node.outputs, name)
        return writers


def runtime_folder() -> Path:
    """Folder of notes and sockets, which no other user may enter.
    Raises GraphError if it is not private, cannot be made, or its path is too long for a socket.
    """
    # With it come compression and random numbers, which a key press waits for.
    import tempfile

    stated = os.environ.get("SPARSESKIN_RUNTIME_DIR")
    # The folder of the session may be another user's, as under sudo.
    runtime = Path(os.environ.get("XDG_RUNTIME_DIR") or "/nowhere")
    if stated:
        folder = Path(stated).absolute()
    elif runtime.is_dir() and runtime.stat().st_uid == os.geteuid():
        folder = runtime / "sparseskin"
    else:
        folder = Path(tempfile.gettempdir()) / f"sparseskin-{os.geteuid()}"
    if len(os.fsencode(folder)) > MAX_FOLDER_BYTES:
        raise GraphError(f"{folder}: too long for the path of a socket{_ELSEWHERE}")
    try:
        if not folder.is_symlink():
            folder.mkdir(
                mode=0o700,
                parents=True,
                exist_ok=True,
            )
        check_private(folder)
    except OSError as error:
        raise GraphError(f"{folder}: {error.strerror}{_ELSEWHERE}") from error
    except SparseskinError as error:
        raise GraphError(f"{error}{_ELSEWHERE}") from error
    return folder


def control_path(pid: int) -> str:
    """Path of the control socket of the graph of a launcher."""
    return str(runtime_folder() / f"{pid}.sock")


def socket_path(number: int) -> str:
    """Path of the socket of a node, by its number: a name would make it too long."""
    return str(runtime_folder() / f"{os.getpid()}.{number}.sock")


def page_path(number: int) -> str:
    """Path of the file with which a node opens its live page in a browser."""
    return str(runtime_folder() / f"{os.getpid()}.{number}.html")


def write_note(graph: RunningGraph) -> None:
    """Write the note of a graph that listens at its control socket, in place of an earlier one.
    Raises GraphError if that cannot be done.
    """
    folder = runtime_folder()
    part = folder / f"{graph.pid}{PART}"
    try:
        # Renamed once it is whole: others read notes at any time.
        part.write_text(json.dumps(asdict(graph)))
        part.replace(folder / f"{graph.label}.json")
    except OSError as error:
        raise GraphError(f"{folder / graph.label}.json: {error.strerror}") from error


def remove_note(graph: RunningGraph) -> None:
    """Remove the note of a graph: nobody can find it any more."""
    (runtime_folder() / f"{graph.label}.json").unlink(missing_ok=True)


def running_graphs(starting: bool = False) -> list[RunningGraph]:
    """All graphs that run and can be joined, and with `starting` those that are starting; what
    graphs that are gone have left is removed.
    """
    folder = runtime_folder()
    graphs = []
    for path in sorted(folder.glob("*.json")):
        with contextlib.suppress(*_NO_NOTE):
            graph = _read_note(path)
            if is_running(graph):
                graphs.append(graph)
            elif remove_files(graph.pid):
                path.unlink()
    with contextlib.suppress(OSError):
        _remove_strays(folder)
    return [graph for graph in graphs if starting or not graph.starting]


def _remove_strays(folder: Path) -> None:
    """Remove files of processes that are gone and have no note: a node that was still starting as
    its launcher was killed makes files after the note is gone.
    """
    # A note is NAME-PID.json, any other file PID.WHATEVER.
    noted = set()
    for path in folder.glob("*.json"):
        _, _, number = path.stem.rpartition("-")
        noted.add(number)
    numbers = set()
    for path in folder.iterdir():
        number, _, _ = path.name.partition(".")
        numbers.add(number)
    for number in numbers - noted:
        if number.isdecimal() and not os.path.exists(f"/proc/{number}"):
            remove_files(int(number))


def is_running(graph: RunningGraph) -> bool:
    """True if the launcher of a graph listens at its control socket."""
    try:
        return is_served(Path(graph.control))
    except OSError:
        # No descriptor is free: nothing is known, and nothing may be removed.
        return True


def remove_files(pid: int) -> bool:
    """Remove the sockets, the pages and the part of a note that a process has left; False if
    somebody listens to one of the sockets.
    """
    # Nothing else is removed, whatever a user keeps in this folder.
    of_launcher = re.compile(rf"{pid}(\.\d+)?\.sock|{pid}(\.\d+\.html|{PART})")
    served = False
    for path in runtime_folder().glob(f"{pid}.*"):
        # A process that ends removes its files, too.
        with contextlib.suppress(FileNotFoundError):
            is_socket = path.suffix == ".sock"
            if not of_launcher.fullmatch(path.name):
                continue
            # A folder, or a link of somebody's, is not ours either.
            mode = path.lstat().st_mode
            is_ours = stat.S_ISREG(mode)
            if is_socket:
                is_ours = stat.S_ISSOCK(mode)
            if not is_ours:
                continue
            if is_socket and is_served(path):
                served = True
            else:
                path.unlink()
    return not served


def _read_note(path: Path) -> RunningGraph:
    """The graph that a note describes; any of `_NO_NOTE` where this program has not written it."""
    if not stat.S_ISREG(path.lstat().st_mode):
        raise ValueError(f"{path}: is no file")
    fields: dict[str, Any] = json.loads(path.read_bytes())
    nodes = {}
    for name, node in fields.pop("nodes").items():
        nodes[name] = RunningNode(**node)
    graph = RunningGraph(**fields, nodes=nodes)
    if graph.label != path.stem or not isinstance(graph.pid, int):
        raise ValueError(f"{path}: is no note")
    return graph


def choose_graph(name: str | None, option: str = "--graph") -> RunningGraph:
    """The graph of that name, label or process number, stated with an option, or the only one; one
    that is starting is waited for, `PATIENCE_S` at most.
    Raises GraphError if there is none, or more than one.
    """
    graphs = running_graphs(starting=True)
    candidates = _named(graphs, name)
    deadline_s = time.monotonic() + PATIENCE_S
    # Only where no other graph can be meant is one that is starting waited for.
    if candidates and all(graph.starting for graph in candidates):
        print(
            f"{candidates[0].label}: is starting; waiting until it runs",
            file=sys.stderr,
            flush=True,
        )
    while candidates and all(graph.starting for graph in candidates):
        if time.monotonic() >= deadline_s:
            raise GraphError(
                f"{candidates[0].label}: is still starting after {PATIENCE_S:g} s; its "
                "terminal shows what it waits for"
            )
        time.sleep(POLL_S)
        graphs = running_graphs(starting=True)
        candidates = _named(graphs, name)

    matching = [graph for graph in candidates if not graph.starting]
    labels = [graph.label for graph in graphs if not graph.starting]
    if not labels:
        raise GraphError(
            "no graph runs on this host (start one: sparseskin launch NAME)"
        )
    if not matching:
        hint = did_you_mean(str(name), labels)
        raise GraphError(f"{option} {name}: no such graph runs{hint}".strip())
    if len(matching) > 1:
        choices = ", ".join(graph.label for graph in matching)
        advice = "choose one"
        if option:
            advice += f" with {option}"
        raise GraphError(f"several graphs run; {advice}: {choices}")
    return matching[0]


def _named(graphs: list[RunningGraph], name: str | None) -> list[RunningGraph]:
    """Those of some graphs that a name can mean; None: all."""
    if name is None:
        return graphs
    matching = []
    for graph in graphs:
        if name in (graph.name, graph.label, str(graph.pid)):
            matching.append(graph)
    return matching
