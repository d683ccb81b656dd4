"""A graph launched as its user launches it, observed from outside: processes, files, frames."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple, Self

import zmq
from processes import COMMAND, Program, note_of_graph, wait_until

from sparseskin.messages import MessageError, decode
from sparseskin.nodes.clock import SystemClock
from sparseskin.nodes.compressor.phi.rotation import FIXED
from sparseskin.nodes.network.keys import read_key_pair
from sparseskin.nodes.network.sockets import Reader, make_context
from sparseskin.nodes.process.control import ControlClient

FULL = bool(os.environ.get("SPARSESKIN_STRESS"))
"""True if tests run at the sizes whose figures stand in the documents: `make stress`."""
PATIENCE_S = 120.0
"""Time after which a wait fails: far beyond what anything takes that goes well."""
RATE_HZ = 100.0
FRESH_NS = 500_000_000
"""Age at which a frame that comes is one that did not wait for older ones."""
TESTS = Path(__file__).resolve().parents[1]
PYTHONPATH = f"{TESTS}{os.pathsep}{TESTS / 'plugins'}"
SECURITY = """
[security]
keys = "keys"
key = "edge"
"""
"""Lines for a launch file: a graph with keys."""
_SENSED, _RECONSTRUCTED = "/skin/taxels", "/skin/reconstruction"


class GraphRun(Program):
    """One run of `sparseskin launch`, to be used in a `with`: nothing of it outlives that.

    `launch`: text of a launch file, or the name of one; nodes of this folder are
    "stress.MODULE:CLASS". `folder`: empty, keeps what it writes; by default a temporary one.
    `environment`: variables that differ from those of this process.
    """

    def __init__(
        self,
        launch: str,
        *arguments: str,
        folder: Path | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._is_temporary = folder is None
        folder = (
            folder or Path(tempfile.mkdtemp(prefix="sparseskin-graph-"))
        ).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        if "\n" in launch:
            (folder / "graph.toml").write_text(launch)
            launch = "graph.toml"
        self.stack = contextlib.ExitStack()
        out, err = (
            (folder / f"{name}.txt").open("wb") for name in ("stdout", "stderr")
        )
        with out, err:
            super().__init__(
                *("launch", launch, "--summary", "summary.json", *arguments),
                **{"cwd": folder, "limits": True, "start_new_session": True},
                **{"stdout": out, "stderr": err},
                environment={
                    **{"PYTHONPATH": PYTHONPATH, "SPARSESKIN_FAST": "auto"},
                    **(environment or {}),
                },
            )
        self._client: ControlClient | None = None
        self._state: dict[str, Any] = {}
        self._n_requests = 0
        try:
            self.wait_for("[launch] ready")
        except BaseException:
            self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        self.stack.close()
        super().__exit__()
        if self._is_temporary:
            shutil.rmtree(self.cwd, ignore_errors=True)

    def start(self, *arguments: str, **options: Any) -> subprocess.Popen[bytes]:
        """Start a command `sparseskin` that sees this graph; `options` are those of `Popen`."""
        command = [sys.executable, *COMMAND, *arguments]
        return subprocess.Popen(command, cwd=self.cwd, env=self.environment, **options)

    @property
    def log(self) -> list[str]:
        """Lines that launcher and nodes have logged so far, without their times."""
        text = (self.cwd / "stderr.txt").read_text(errors="replace")
        return [
            re.sub(r"^\d\d:\d\d:\d\d\.\d{3} ", "", line) for line in text.splitlines()
        ]

    def wait_for(self, token: str) -> str:
        """Wait until a line of the log holds a token; the last such line."""
        found: list[str] = []

        def has_come() -> bool:
            ended = self.process.poll() is not None
            found[:] = [line for line in self.log if token in line]
            if ended and not found:
                raise AssertionError(
                    f"the graph ended without {token!r}: {self.log[-5:]}"
                )
            return bool(found)

        wait_until(has_come, repr(token))
        return found[-1]

    def page(self) -> str:
        """Address of the live page, once it is served."""
        return self.wait_for("live page: ").partition("live page: ")[2].split()[0]

    def note(self) -> Any:
        """The launcher's note of the graph, by which other programs find it."""
        return json.loads(note_of_graph(self.notes).read_text())

    def stopped(self, before: Mapping[str, int], *but: str) -> list[str]:
        """Nodes, except those named, that are gone or run as another process than before."""
        now = self.nodes()
        return [
            name
            for name, pid in before.items()
            if name not in but and now.get(name) != pid
        ]

    def state(self) -> dict[str, dict[str, Any]]:
        """Newest state of each node that the launcher has published, by name."""
        if self._client is None:
            path = self.notes / f"{self.process.pid}.sock"
            wait_until(path.exists, "the control socket")
            self._client = self.stack.enter_context(closing(ControlClient(str(path))))
            self._client.send({"watch": True})
        for fields in self._client.receive() or ():
            if "graph" in fields:
                self._state = {node["name"]: node for node in fields["graph"]["nodes"]}
        return self._state

    def ask(self, node: str, command: str, value: Any) -> None:
        """Send a node a command, as the terminal of the graph does."""
        self.state()
        self._n_requests += 1
        number = str(self._n_requests)
        self._client.send(
            {"id": number, "node": node, "command": command, "value": value}
        )

    def end(self) -> int:
        """End the graph as Ctrl-C does, wait for it, and return its exit code."""
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGINT)
        return self.wait()

    def wait(self, patience_s: float | None = PATIENCE_S) -> int:
        """Wait for the end of the graph, for ever where `patience_s` is None; the exit code."""
        try:
            return self.process.wait(patience_s)
        except subprocess.TimeoutExpired as error:
            raise AssertionError(f"the graph does not end: {self.log[-5:]}") from error

    def summary(self) -> Any:
        """The summary that the graph has written as it ended."""
        return json.loads((self.cwd / "summary.json").read_text())

    def left_behind(self) -> list[str]:
        """Processes, notes and unfinished files that are there after the end; to be empty."""
        left = [f"process {line.strip()}" for line in self.survivors().values()]
        if self.notes.is_dir():
            left += [f"note {path.name}" for path in self.notes.iterdir()]
        for pattern in ("*.part", "core*"):
            left += [f"file {path.name}" for path in self.cwd.glob(pattern)]
        return left


def launch_text(
    nodes: Mapping[str, Any], graph: Mapping[str, Any] | None = None
) -> str:
    """Text of a launch file: settings of nodes by name, and of [graph]; None: left out."""
    tables = {
        f"nodes.{name}": {"type": name, **settings} for name, settings in nodes.items()
    }
    return "".join(
        f"[{table}]\n"
        + "".join(
            f"{key} = {json.dumps(value)}\n"
            for key, value in values.items()
            if value is not None
        )
        for table, values in {"graph": graph or {}, **tables}.items()
    )


def graph_text(
    graph: Mapping[str, Any] | None = None, **changed: Mapping[str, Any]
) -> str:
    """Launch file of the graph to which faults are done, with changed settings by name."""
    nodes: dict[str, dict[str, Any]] = {
        "sensor": {"source": "scene:path_40", "rate_hz": RATE_HZ},
        "compressor": {"rows": FIXED},
        "reconstructor": {"preset": "skin", "depth": 0},
        "monitor": {"page": False},
    }
    nodes = {
        name: {**settings, **changed.get(name, {})} for name, settings in nodes.items()
    }
    restarts = {"restart": "on-failure", "restart_window_s": 1}
    return launch_text(nodes, {**restarts, **(graph or {})})


class Seen(NamedTuple):
    """Stamp of a frame and time of its arrival, ns on the graph's clock."""

    stamp_ns: int
    came_ns: int


class Probe:
    """Notes each frame of the patch "skin" that is acquired or reconstructed, in a thread."""

    def __init__(self, graph: GraphRun) -> None:
        note = graph.note()
        self._clock = SystemClock(note["offset_ns"])
        self.sensed: list[Seen] = []
        self.reconstructed: list[Seen] = []
        self._seen = {_SENSED: self.sensed, _RECONSTRUCTED: self.reconstructed}
        keys = read_key_pair(Path(note["key_file"])) if note["key_file"] else None
        self._context = make_context()
        topics = list(self._seen)
        self._reader = Reader(
            self._context, "probe", (), topics, present=False, keys=keys
        )
        for node in note["nodes"].values():
            if any(topic in node["outputs"] for topic in topics):
                self._reader.connect(node["endpoint"], node["key"])
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read, name="probe", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        self._context.destroy(linger=0)

    def now_ns(self) -> int:
        """Time on the graph's clock."""
        return self._clock.now_ns()

    def lost(self, since_ns: int) -> tuple[int, int]:
        """Frames acquired since a time and not reconstructed, and acquired, to the last one."""
        done = {seen.stamp_ns for seen in list(self.reconstructed)}
        until_ns = max(done, default=0)
        since_ns = max(since_ns, min(done, default=0) - 1)
        sensed = {seen.stamp_ns for seen in list(self.sensed)}
        sensed = {stamp_ns for stamp_ns in sensed if since_ns < stamp_ns <= until_ns}
        return len(sensed - done), len(sensed)

    def wait_for_frame(
        self, after_ns: int | None = None, max_age_ns: float = FRESH_NS
    ) -> float:
        """Seconds until a frame acquired after a time (now) comes, at most `max_age_ns` old."""
        begin_ns = self.now_ns() if after_ns is None else after_ns
        found: list[Seen] = []

        def has_come() -> bool:
            for seen in reversed(list(self.reconstructed)):
                if seen.stamp_ns <= begin_ns:
                    break
                if seen.came_ns - seen.stamp_ns < max_age_ns:
                    found[:] = [seen]
            return bool(found)

        wait_until(has_come, "the reconstruction of a frame acquired after the fault")
        return (found[0].came_ns - begin_ns) / 1e9

    def _read(self) -> None:
        poller = zmq.Poller()
        poller.register(self._reader.socket, zmq.POLLIN)
        while not self._closing.is_set():
            poller.poll(20)
            while (parts := self._reader.receive()) is not None:
                try:
                    message = decode(*parts)
                except MessageError:
                    continue
                if message.topic in self._seen:
                    self._seen[message.topic].append(
                        Seen(message.stamp_ns, self.now_ns())
                    )


class Outcome(NamedTuple):
    """Frames lost of those acquired, nodes that stopped, and what a graph has left behind."""

    lost: int
    of: int
    stopped: list[str]
    left: list[str]


class ObservedGraph(GraphRun):
    """A graph with a probe beside it; arguments as those of `GraphRun`."""

    def __init__(self, launch: str, *arguments: str, **options: Any) -> None:
        super().__init__(launch, *arguments, **options)
        self.probe = self.stack.enter_context(Probe(self))
        self.begin()

    def begin(self) -> None:
        """Observe from now on: frames that are lost, nodes that stop."""
        self.began_ns, self._before = self.probe.now_ns(), self.nodes()

    def outcome(self, *but: str) -> Outcome:
        """End the graph; what was lost and what stopped since `begin`, except nodes named."""
        lost, n_sensed = self.probe.lost(self.began_ns)
        stopped = self.stopped(self._before, *but)
        self.end()
        return Outcome(lost, n_sensed, stopped, self.left_behind())
