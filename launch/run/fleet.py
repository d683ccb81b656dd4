"""The processes of one graph: started, joined, listened to, started again, ended."""

import os
import secrets
import selectors
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sparseskin.launch.launchfile.hosts import Credentials
from sparseskin.launch.launchfile.processes import by_process
from sparseskin.launch.launchfile.spec import LaunchFile, NodeSpec
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.graph import Link
from sparseskin.nodes.network.keys import read_key_pair
from sparseskin.nodes.network.sockets import Peer
from sparseskin.nodes.process.control import Document

from .process import NodeProcess, awake_s, exit_text, start_process
from .restarts import Restarts
from .running import RunningGraph, RunningNode, control_path, page_path, socket_path

START_S = 240.0
"""Longest start of all nodes together, seconds: ten times what compiling all loops takes, which on
a busy host is three times as much."""
GRACE_S = 2.0
"""Time from one request to end to the next, more forceful one, seconds."""
POLL_S = 0.1
"""Longest wait for events, seconds: restarts and hangs are noticed within it."""
LAST_READS = 5
"""Reads of a node whose pipes are closed next. Each reads a part; a pipe holds fewer than these."""
ANY_PORT = "tcp://127.0.0.1:*"

EXIT_FAILED = 1
EXIT_USAGE = 2

Hear = Callable[[NodeProcess, Document], None]


class Fleet:
    """The node processes of a graph and their restarts, by name; parameters as of `Launcher`, and
    of its terminal.

    `offset_ns`: time of day minus monotonic time as the graph started, the clock of all its nodes.
    `exit_code` is not 0 once a node has failed that the graph needs, `late_code` once one has that
    it can do without, or has raised an error and gone on. `left` is what nodes that have died left
    behind, in words, by name. While `supervised`, a node that fails is restarted as its policy
    states. `hear` is called with (node, event) for events that concern others than the fleet.

    Raises KeyFileError if the graph that is joined asks for a key that this user may not read.
    """

    def __init__(
        self,
        launch: LaunchFile,
        offset_ns: int,
        log: Callable[[str], None],
        max_frames: int | None = None,
        joined: RunningGraph | None = None,
        record: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._launch = launch
        self._offset_ns = offset_ns
        self._log = log
        self._record = record
        self._max_frames = max_frames
        self._joined = joined
        self._selector = selectors.DefaultSelector()
        self._links = list(launch.links)
        self._to_pause: set[str] = set()
        self._bound: dict[str, str] = {}
        self._page_token = secrets.token_urlsafe(24)
        # By name: a node that is started again is another `NodeProcess`. Nothing is ever deleted,
        # as the number of a node is its position here.
        self.restarts = {}
        for name, spec in launch.nodes.items():
            self.restarts[name] = Restarts(spec.restart)
        self.nodes: dict[str, NodeProcess] = {}
        self.exit_code = 0
        self.late_code = 0
        self.left: dict[str, list[str]] = {}
        self.supervised = False
        self.hear: Hear = lambda node, event: None

        keys = launch.credentials
        if joined is not None and joined.key_file:
            # Nobody reads nodes that join a graph: no peer needs to be allowed.
            pair = read_key_pair(Path(joined.key_file))
            keys = Credentials(pair, joined.key_file, {}, {}, {})
        self._keys = keys
        self._public = ""
        key_of_host: Mapping[str, str] = {}
        if keys is not None:
            self._public = keys.key_pair.public
            key_of_host = keys.servers

        # Writers that are not processes of this launcher.
        self._peers: dict[str, Peer] = {}
        for name, spec in launch.elsewhere.items():
            # Hosts that share a key are not listed: theirs is the own one.
            key = key_of_host.get(spec.host, self._public)
            self._peers[name] = Peer(name, spec.public, spec.host, key)
        if joined is not None:
            for name, node in joined.nodes.items():
                self._peers[name] = Peer(name, node.endpoint, key=node.key)

    def __iter__(self) -> Iterator[NodeProcess]:
        return iter(list(self.nodes.values()))

    def spawn(self) -> None:
        """Start all processes of the launch file."""
        for specs in by_process(self._launch.nodes.values()):
            self._start_process(specs, late=self._joined is not None)

    def add(self, spec: NodeSpec, topics: list[str]) -> None:
        """Start one process more in a graph that runs; it reads the topics."""
        writers: dict[str, str] = {}
        for node in self:
            writers |= dict.fromkeys(node.spec.outputs, node.name)
        for topic in topics:
            self._links.append(Link(topic, writers[topic], spec.name))
        self.restarts[spec.name] = Restarts(spec.restart)
        self._start_process([spec], late=True)

    def note(self) -> RunningGraph:
        """The note by which others find this graph and its topics, once all nodes are bound."""
        nodes = {}
        for node in self:
            nodes[node.name] = RunningNode(
                node.spec.type_name,
                node.endpoint,
                node.outputs,
                self._public,
            )
        key_file = ""
        if self._keys is not None:
            key_file = self._keys.file
        return RunningGraph(
            self._launch.name,
            os.getpid(),
            self._offset_ns,
            self._launch.text,
            nodes,
            key_file=key_file,
            page_token=self._page_token,
        )

    def connect(self, node: NodeProcess, distant: bool = False) -> None:
        """Send a node the endpoints of its writers on this host, or of those on other hosts."""
        writers = {link.writer for link in self._links if link.reader == node.name}
        peers = []
        for name in sorted(writers):
            if (name in self._launch.elsewhere) == distant:
                peers.append(asdict(self._peers[name]))
        # A node waits for those of this host, though there may be none.
        if peers or not distant:
            node.command("connect", peers=peers)

    def command_all(self, command: str) -> None:
        for node in self:
            node.command(command)

    def condition(self, node: NodeProcess) -> str:
        """Condition of a node, in a word or two."""
        if self.restarts[node.name].due_s is not None:
            return "restarting"
        return node.condition

    def watch(self, fd: Any, on_ready: Callable[[], None]) -> None:
        """Wait for another file descriptor than a pipe, too."""
        self._selector.register(fd, selectors.EVENT_READ, on_ready)

    def unwatch(self, fd: Any) -> None:
        self._selector.unregister(fd)

    def serve(self) -> None:
        """Wait for events of the nodes, at most `POLL_S`, and handle them."""
        self._listen_to_all()
        now_s = awake_s()
        for node in self:
            # Started again meanwhile, with another node of its process.
            if self.nodes[node.name] is not node:
                continue
            self._check(node, now_s)
            due_s = self.restarts[node.name].due_s
            if due_s is not None and due_s <= now_s:
                self._start_again(node)

    def end_all(self) -> None:
        """End every process: command, then SIGTERM, then SIGKILL; log the use of signals."""
        self.supervised = False
        self.command_all("stop")
        for node in self:
            # One that is still starting does not listen yet.
            if not node.endpoint:
                node.send_signal(signal.SIGTERM)
        for number in (signal.SIGTERM, signal.SIGKILL):
            deadline_s = awake_s() + GRACE_S
            # A node whose pipes are full could not end.
            while self._alive() and awake_s() < deadline_s:
                self._listen_to_all()
            for node in self._alive():
                self._log(f"[launch] {node.name} does not end: {number.name}")
                node.send_signal(number)
        for node in self:
            self._close(node)

    def _listen_to_all(self) -> None:
        ready = self._selector.select(POLL_S)
        # A node has two pipes, which are read together: it is listened to once.
        targets = {id(key.data): key.data for key, _ in ready}
        for target in targets.values():
            if isinstance(target, NodeProcess):
                self._listen(target)
            else:
                target()

    def _start_process(self, specs: Sequence[NodeSpec], late: bool) -> None:
        """Start a process of nodes; those that were bound before are bound there again."""
        configured = [(spec, self._config(spec, late)) for spec in specs]
        for node in start_process(configured):
            self.nodes[node.name] = node
            for pipe in node.pipes:
                self._selector.register(pipe, selectors.EVENT_READ, node)

    def _config(self, spec: NodeSpec, late: bool) -> Document:
        """Configuration of a node, as of `Runner`."""
        # The number of a node stays the same when it is started again.
        number = list(self.restarts).index(spec.name)
        control = ""
        if spec.cls.watches:
            # A monitor that has joined a graph watches that one.
            pid = os.getpid()
            if self._joined is not None:
                pid = self._joined.pid
            control = control_path(pid)
        return {
            "name": spec.name,
            "type": spec.type_name,
            "settings": spec.values,
            "folder": self._launch.folder,
            **asdict(spec.scheduling),
            "endpoint": self._endpoint(spec, number),
            **self._links_of(spec.name),
            "offset_ns": self._offset_ns,
            "max_frames": self._max_frames,
            "late": late,
            "control": control,
            "page_token": self._page_token,
            "page_file": page_path(number),
            "public": spec.public,
            "security": self._keys and asdict(self._keys),
        }

    def _endpoint(self, spec: NodeSpec, number: int) -> str:
        """Where a node publishes: where it did before, so that its readers stay connected."""
        if spec.name in self._bound:
            return self._bound[spec.name]
        if self._launch.transport == "ipc":
            return f"ipc://{socket_path(number)}"
        return ANY_PORT

    def _links_of(self, name: str) -> Document:
        """Topics that a node reads, its readers, and which of both are on other hosts."""
        elsewhere = self._launch.elsewhere
        inputs = {}
        readers = set()
        for link in self._links:
            if link.reader == name:
                inputs[link.topic] = link.writer
            if link.writer == name:
                readers.add(link.reader)
        distant_inputs = {}
        for topic, writer in inputs.items():
            if writer in elsewhere:
                distant_inputs[topic] = elsewhere[writer].host
        # The start of a graph does not wait for observers.
        distant_readers = []
        for reader in sorted(readers):
            if reader in elsewhere and not elsewhere[reader].cls.observes:
                distant_readers.append(reader)
        return {
            "inputs": list(inputs),
            "readers": sorted(readers),
            "distant_readers": distant_readers,
            "distant_inputs": distant_inputs,
        }

    def _companions(self, node: NodeProcess) -> list[NodeProcess]:
        """The nodes of the process of a node, itself included, whose streams have not ended."""
        companions = []
        for each in self:
            if each.process is node.process and not each.ended:
                companions.append(each)
        return companions

    def _start_again(self, dead: NodeProcess) -> None:
        """Start the nodes of a process that died, at their endpoints, and paused as they were."""
        nodes = []
        for node in self:
            is_due = self.restarts[node.name].due_s is not None
            if is_due and node.process is dead.process:
                nodes.append(node)

        specs = []
        for node in nodes:
            self._close(node)
            n_restarts = self.restarts[node.name].total
            self._log(f"[launch] {node.name} is started again (restart {n_restarts})")
            if node.state.get("paused"):
                self._to_pause.add(node.name)
            # What was set while it ran stays set.
            spec = node.spec.with_live(node.settings)
            specs.append(spec.again(n_restarts))
        # Not before: what they have reported last is no further failure.
        for node in nodes:
            self.restarts[node.name].due_s = None
        try:
            self._start_process(specs, late=True)
        except SparseskinError as error:
            self._died(dead, EXIT_FAILED, str(error))
            return
        for node in nodes:
            self.nodes[node.name].earlier = node.counts

    def _close(self, node: NodeProcess) -> None:
        """Read what is left of a node, and close its pipes."""
        for _ in range(LAST_READS):
            self._listen(node)
        # A child of the node's may still hold the other end: no pipe need have ended.
        if not node.closed:
            self._unregister(node.pipes)
        node.close()

    def _unregister(self, pipes: Iterable[Any]) -> None:
        for pipe in pipes:
            if pipe in self._selector.get_map():
                self._selector.unregister(pipe)

    def _alive(self) -> list[NodeProcess]:
        return [node for node in self if node.exit_code() is None]

    def _check(self, node: NodeProcess, now_s: float) -> None:
        """Check whether a node has died or hangs."""
        restarts = self.restarts[node.name]
        code = node.exit_code()
        if code is None:
            self._check_hang(node, now_s)
        elif node.ended:
            if not node.closed:
                self._close(node)
        elif restarts.due_s is None:
            # Its pipes may hold the end of its stream, or the reason of its failure.
            self._listen(node)
            if not node.ended and restarts.due_s is None:
                names = _names(self._companions(node))
                self._died(
                    node, EXIT_FAILED, f"{names} ended too early: {exit_text(code)}"
                )

    def _check_hang(self, node: NodeProcess, now_s: float) -> None:
        """Kill the process of a node that has been silent for too long: it is restarted then."""
        policy = node.spec.restart
        if not self.supervised or node.ended or not policy.restarts:
            return
        hang_s = policy.hang_s
        if hang_s and not node.ready:
            # To import and to open a device takes its time.
            hang_s = max(hang_s, START_S)
        if not hang_s or now_s - node.heard_s <= hang_s:
            return
        nodes = self._companions(node)
        # Not SIGTERM: a process that hangs may handle no signal.
        have = "have"
        if len(nodes) == 1:
            have = "has"
        self._log(
            f"[launch] {_names(nodes)} {have} been silent for {hang_s:g} s: SIGKILL"
        )
        node.send_signal(signal.SIGKILL)
        # They die with it: their silence is no further hang.
        for companion in nodes:
            companion.heard_s = now_s

    def _listen(self, node: NodeProcess) -> None:
        if node.closed:
            return
        events, log = node.read()
        # A pipe at its end would be ready for ever.
        self._unregister(node.closed_pipes)
        for line in log:
            self._log(f"[{node.name}] {line}")
        for event in events:
            self._take(node, event)

    def _take(self, node: NodeProcess, event: Document) -> None:
        """Handle an event. Its keys are those of `Control.emit` where the node sends it, in
        `nodes.process.runner` and `nodes.process.run_node`.
        """
        for line in event.get("trace", "").splitlines():
            self._record(f"[{node.name}] {line}")
        match event["event"]:
            case "bound":
                self._take_bound(node, event["endpoint"], event["unused"])
            case "compiled":
                node.compiled = event["done"], event["of"]
            case "ready":
                node.ready = True
                # Not before: what comes from other hosts can be passed on from now on.
                self.connect(node, distant=True)
                if self.supervised:
                    node.command("start")
                if node.name in self._to_pause:
                    self._to_pause.discard(node.name)
                    node.command("pause", value=True)
            case "heartbeat":
                node.lacks = event["lacks"]
                node.line = event["line"]
                node.counted = event["counts"]
                node.state = event["state"]
                node.refusal = event["refusal"]
                node.heard = event["heard"]
                node.clocks = event["clocks"]
            case "ended":
                node.ended = True
                node.counted = event["counts"]
                node.report = event["report"]
                node.clocks = event["clocks"]
            case "failed":
                # The node has logged the reason.
                self._fail(node, EXIT_USAGE)
            case "error":
                self._died(node, event["code"], f"[{node.name}] error: {event['text']}")
                return
            case "raised":
                # The node has logged the error, and goes on.
                self.late_code = self.late_code or EXIT_FAILED
            case "answer":
                node.settings = event["settings"]
                node.state = event["state"]
            case _:
                self._log(f"[{node.name}] {event}")
        self.hear(node, event)

    def _take_bound(self, node: NodeProcess, endpoint: str, unused: list[str]) -> None:
        """A node publishes at an endpoint, all but the topics that its settings leave out."""
        node.endpoint = endpoint
        self._bound[node.name] = endpoint
        node.outputs = [topic for topic in node.spec.outputs if topic not in unused]
        self._peers[node.name] = Peer(node.name, endpoint, key=self._public)
        # In a graph that runs, nobody waits until all nodes are bound.
        if self.supervised:
            self.connect(node)

    def _died(self, failed: NodeProcess, code: int, text: str) -> None:
        """A process has ended before its time: start its nodes again, or end the graph with them.
        `failed` is the node that is known to have failed.
        """
        nodes = self._companions(failed)
        # It has ended, or another node of its process has reported it.
        if failed not in nodes or self.restarts[failed.name].due_s is not None:
            return
        for node in nodes:
            unfinished = node.spec.cls.left_behind(node.spec.settings)
            if unfinished:
                self.left.setdefault(node.name, []).append(unfinished)

        line = _death_line(nodes, failed, text)
        if self.supervised and code != EXIT_USAGE:
            # In a report each failure stands beside the name of the node.
            why = text.removeprefix(f"[{failed.name}] ")
            why = why.removeprefix(f"{_names(nodes)} ")
            refusal = self._schedule_restart(nodes, why)
            if refusal is None:
                self._log(line)
                return
            line += refusal
        self._end_dead(nodes, code, line)

    def _schedule_restart(self, nodes: Sequence[NodeProcess], why: str) -> str | None:
        """Count a failure of all nodes of a process, and set the time of their restart; where there
        is none, return the reason, as of `Restarts.failed`.
        """
        refusals = [self.restarts[node.name].failed(awake_s(), why) for node in nodes]
        # The nodes of a process have one policy, and fail together: all values are the same.
        return refusals[-1]

    def _end_dead(self, nodes: Sequence[NodeProcess], code: int, line: str) -> None:
        """Log the line of a failure, and end the nodes, which are not started again."""
        for node in nodes:
            node.ended = True
        self._log(line)
        for node in nodes:
            self._fail(node, code)
            self.hear(node, {"event": "died"})

    def _fail(self, node: NodeProcess, code: int) -> None:
        """A node cannot go on. The graph ends with it, if it is one that it needs."""
        node.failed = True
        if node.spec.cls.required:
            self.exit_code = self.exit_code or code
        else:
            self.late_code = max(self.late_code, code)


def _death_line(nodes: Sequence[NodeProcess], failed: NodeProcess, text: str) -> str:
    """Log line of a failure; of a text of the failed node itself, with its companions named."""
    if not text.startswith("["):
        return f"[launch] {text}"
    companions = [node for node in nodes if node is not failed]
    if companions:
        return f"{text} (of the same process: {_names(companions)})"
    return text


def _names(nodes: Iterable[NodeProcess]) -> str:
    return ", ".join(node.name for node in nodes)
