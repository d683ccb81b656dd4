"""Nodes whose processes are played by a test: what they are sent, and what they answer."""

import contextlib
import itertools
import json
import signal

from sparseskin.launch.launchfile.load import load
from sparseskin.launch.run import controls
from sparseskin.launch.run import fleet as fleets
from sparseskin.launch.run import launcher as launchers
from sparseskin.launch.run import process as processes
from sparseskin.launch.run.fleet import Fleet
from sparseskin.launch.run.process import NodePipes, NodeProcess

GRAPH = """
[graph]
{graph}
[nodes.sensor]
type = "sensor"
source = "scene:path_40"
[nodes.compressor]
type = "compressor"
[nodes.reconstructor]
type = "reconstructor"
[nodes.monitor]
type = "monitor"
page = false
"""
NAMES = ["sensor", "compressor", "reconstructor", "monitor"]

#: Wording of the launcher, in one place; the tests state which of these is logged, and when.
SAYS = {
    "died": "[launch] {} ended too early: {}",
    "again": "[launch] {} is started again (restart {})",
    "given up": " ({} restarts within {} s: given up)",
    "silent": "[launch] {} {} been silent for {:g} s: SIGKILL",
    "stubborn": "[launch] {} does not end: {}",
    "error": "[{}] error: {}",
    "of process": " (of the same process: {})",
    "drain": "[launch] not drained after 5 s: {}",
    "late": "{} (waits for {})",
    "last": "{} (has not ended its stream)",
    "imports": "{} has not started: it imports, compiles, or opens its device",
    "start": "[launch] after 240 s: {}",
    "errors": "[launch] {} raised {} errors (see its log)",
    "gone": "[launch] {} was gone before its streams had ended: its last messages may be missing",
    "no answer": "{} has not answered yet",
}


def line(kind, *words):
    return SAYS[kind].format(*words)


class PlayedProcess:
    """Stands in for the process of some nodes: it runs until it is given a code."""

    _pids = itertools.count(1000)

    def __init__(self):
        self.pid = next(self._pids)
        self.code = None
        self.signals = []
        self.obeys = {signal.SIGKILL}

    def poll(self):
        return self.code

    def wait(self):
        return self.code

    def send_signal(self, number):
        self.signals.append(number)
        if number in self.obeys:
            self.code = -number


class Stage:
    """A graph of played nodes and its fleet, under a clock that the test sets."""

    def __init__(self, tmp_path, monkeypatch, graph="", step_s=0.0):
        monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))
        for module in (fleets, processes, launchers, controls):
            monkeypatch.setattr(module, "awake_s", self._awake_s)
        monkeypatch.setattr(fleets, "POLL_S", 0.0)
        monkeypatch.setattr(fleets, "start_process", self._start)
        (tmp_path / "played.toml").write_text(GRAPH.format(graph=graph))
        self.launch = load(str(tmp_path / "played.toml"))
        self.now_s = 100.0
        self.step_s = step_s
        """What the clock advances by whenever it is read, seconds."""
        self.lines = []
        self.started = []
        """Names of the nodes of each process that was started, in order."""
        self._ends = {}
        self._rest = {}
        self.fleet = Fleet(self.launch, 0, self.lines.append)

    def node(self, name):
        return self.fleet.nodes[name]

    def run(self, supervised=True):
        """Start the graph, to where all nodes are ready."""
        self.fleet.spawn()
        for name in NAMES:
            self.bound(name)
        self.fleet.serve()
        for name in NAMES:
            self.says(name, "ready")
        self.fleet.serve()
        for name in NAMES:
            self.received(name)
        self.fleet.supervised = supervised

    def die(self, name, code=3):
        self.node(name).process.code = code
        self.fleet.serve()

    def _awake_s(self):
        self.now_s += self.step_s
        return self.now_s

    def _start(self, nodes):
        process = PlayedProcess()
        self.started.append([spec.name for spec, _ in nodes])
        made = []
        for spec, config in nodes:
            pipes = NodePipes(spec)
            companions = [other.name for other, _ in nodes if other is not spec]
            made.append(
                NodeProcess(spec, config | {"companions": companions}, process, pipes)
            )
            self._ends[spec.name] = pipes
            self._rest[spec.name] = b""
        return made

    def received(self, name):
        """What the launcher has sent to a node since the last call."""
        connection = self._ends[name]._channel_of_node
        connection.setblocking(False)
        data = b""
        while True:
            try:
                chunk = connection.recv(1 << 16)
            except BlockingIOError:
                break
            if not chunk:
                break
            data += chunk
        return [json.loads(line) for line in data.splitlines()]

    def commands(self, name):
        """Names of the commands that a node has received since the last call."""
        return [
            fields["command"] for fields in self.received(name) if "command" in fields
        ]

    def says(self, name, event, **fields):
        """A node sends an event."""
        line = json.dumps({"event": event, **fields}).encode() + b"\n"
        self._ends[name]._channel_of_node.sendall(line)

    def prints(self, name, text):
        self._ends[name]._log_of_node.write(text.encode())

    def bound(self, name, **fields):
        """A node binds its socket."""
        self.says(name, "bound", endpoint=f"ipc:///{name}", unused=[], **fields)

    def heartbeat(self, name, **fields):
        silent = {"lacks": [], "line": "", "counts": {}, "state": {}, "refusal": ""}
        self.says(name, "heartbeat", **silent | {"heard": {}, "clocks": {}} | fields)

    def close(self):
        for node in self.fleet:
            node.process.code = 0
            node.close()
        for pipes in self._ends.values():
            pipes.close_of_node()


class Screen:
    """A terminal whose keys the test presses."""

    def __init__(self):
        self.lines = []
        self.recorded = []
        self.keys = []
        self.shown = ""
        self.keyboard_wanted = False

    def log(self, line):
        self.lines.append(line)

    def record(self, line):
        self.recorded.append(line)

    def status(self, text):
        self.shown = text

    @contextlib.contextmanager
    def keyboard(self, wanted):
        self.keyboard_wanted = wanted
        yield

    def pressed(self):
        keys, self.keys = self.keys, []
        return keys
