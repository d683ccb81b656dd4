"""The processes of one graph: started, joined, listened to, started again, ended."""

import os
import secrets
import selectors
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
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

from .process import NodeProcess, awake_s, exit_text, start_process
from .restarts import Restarts
from .running import RunningGraph, RunningNode, control_path, page_path, socket_path

START_S = 240.0
"""Longest start of all nodes together, seconds: ten times what compiling all loops takes, which on
a busy host is three times as much."""
GRACE_S = 2.0
"""Time from one request to end to the next, more forceful one, seconds."""
POLL_S = 0.1
ANY_PORT = "tcp://127.0.0.1:*"

EXIT_FAILED = 1
EXIT_USAGE = 2

Hear = Callable[[NodeProcess, dict[str, Any]], None]


class Fleet:
    """The node processes of a graph and their restarts, by name; parameters as of `Launcher`, and
    of its terminal.

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
        self.restarts = {
            name: Restarts(spec.restart) for name, spec in launch.nodes.items()
        }
        self.nodes: dict[str, NodeProcess] = {}
        self.exit_code = self.late_code = 0
        self.left: dict[str, list[str]] = {}
        self.supervised = False
        self.hear: Hear = lambda node, event: None
        keys = launch.credentials
        if joined is not None and joined.key_file:
            pair = read_key_pair(Path(joined.key_file))
            keys = Credentials(pair, joined.key_file, {}, {}, {})
        self._keys = keys
        self._public = keys.key_pair.public if keys else ""
        servers = keys.servers if keys else {}
        self._peers = {
            name: Peer(
                name, spec.public, spec.host, servers.get(spec.host, self._public)
            )
            for name, spec in launch.elsewhere.items()
        }
        for name, node in joined.nodes.items() if joined else ():
            self._peers[name] = Peer(name, node.endpoint, key=node.key)

    def __iter__(self) -> Iterator[NodeProcess]:
        return iter(list(self.nodes.values()))

    def spawn(self) -> None:
        """Start all processes of the launch file."""
        for specs in by_process(self._launch.nodes.values()):
            self._start_process(specs, late=self._joined is not None)

    def add(self, spec: NodeSpec, topics: list[str]) -> None:
        """Start one process more in a graph that runs; it reads the topics."""
        writers = {topic: node.name for node in self for topic in node.spec.outputs}
        self._links += [Link(topic, writers[topic], spec.name) for topic in topics]
        self.restarts[spec.name] = Restarts(spec.restart)
        self._start_process([spec], late=True)

    def note(self) -> RunningGraph:
        """The note by which others find this graph and its topics, once all nodes are bound."""
        nodes = {
            node.name: RunningNode(
                *(node.spec.type_name, node.endpoint, node.outputs, self._public)
            )
            for node in self
        }
        key_file = self._keys.file if self._keys else ""
        about = self._launch.name, os.getpid(), self._offset_ns, self._launch.text
        return RunningGraph(*about, nodes, key_file, self._page_token)

    def connect(self, node: NodeProcess, distant: bool = False) -> None:
        """Send a node the endpoints of its writers on this host, or of those on other hosts."""
        writers = {link.writer for link in self._links if link.reader == node.name}
        names = sorted(
            name for name in writers if (name in self._launch.elsewhere) == distant
        )
        if names or not distant:
            node.command("connect", peers=[asdict(self._peers[name]) for name in names])

    def command_all(self, command: str) -> None:
        for node in self:
            node.command(command)

    def condition(self, node: NodeProcess) -> str:
        """Condition of a node, in a word or two."""
        due = self.restarts[node.name].due_s is not None
        return "restarting" if due else node.condition

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
            if self.nodes[node.name] is not node:
                continue  # started again meanwhile, with another node of its process
            self._check(node, now_s)
            due_s = self.restarts[node.name].due_s
            if due_s is not None and due_s <= now_s:
                self._start_again(node)

    def end_all(self) -> None:
        """End every process: command, then SIGTERM, then SIGKILL; log the use of signals."""
        self.supervised = False
        self.command_all("stop")
        for node in self:
            if not node.endpoint:  # still starting: it does not listen yet
                node.send_signal(signal.SIGTERM)
        for number in (signal.SIGTERM, signal.SIGKILL):
            deadline = awake_s() + GRACE_S
            while self._alive() and awake_s() < deadline:
                self._listen_to_all()
            for node in self._alive():
                self._log(f"[launch] {node.name} does not end: {number.name}")
                node.send_signal(number)
        for node in self:
            self._close(node)

    def _listen_to_all(self) -> None:
        for data in {
            id(key.data): key.data for key, _ in self._selector.select(POLL_S)
        }.values():
            if isinstance(data, NodeProcess):
                self._listen(data)
            else:
                data()

    def _start_process(self, specs: Sequence[NodeSpec], late: bool) -> None:
        """Start a process of nodes; those that were bound before are bound there again."""
        configs = [self._config(spec, late) for spec in specs]
        for node in start_process(list(zip(specs, configs, strict=True))):
            self.nodes[node.name] = node
            for pipe in node.pipes:
                self._selector.register(pipe, selectors.EVENT_READ, node)

    def _config(self, spec: NodeSpec, late: bool) -> dict[str, Any]:
        """Configuration of a node, as of `Runner`."""
        launch = self._launch
        keys = self._keys
        links = self._links
        elsewhere = launch.elsewhere
        number = list(self.restarts).index(spec.name)
        pid = self._joined.pid if self._joined else os.getpid()
        endpoint = self._bound.get(spec.name, "")
        if not endpoint:
            endpoint = (
                f"ipc://{socket_path(number)}"
                if launch.transport == "ipc"
                else ANY_PORT
            )
        inputs = {link.topic: link.writer for link in links if link.reader == spec.name}
        readers = sorted({link.reader for link in links if link.writer == spec.name})
        return {
            "name": spec.name,
            "type": spec.type_name,
            "settings": spec.values,
            "folder": launch.folder,
            **asdict(spec.scheduling),
            "endpoint": endpoint,
            "inputs": list(inputs),
            "readers": readers,
            "offset_ns": self._offset_ns,
            "max_frames": self._max_frames,
            "late": late,
            "control": control_path(pid) if spec.cls.watches else "",
            "page_token": self._page_token,
            "page_file": page_path(number),
            "public": spec.public,
            "distant_readers": [
                name
                for name in readers
                if name in elsewhere and not elsewhere[name].cls.observes
            ],
            "distant_inputs": {
                topic: elsewhere[writer].host
                for topic, writer in inputs.items()
                if writer in elsewhere
            },
            "security": keys and asdict(keys),
        }

    def _companions(self, node: NodeProcess) -> list[NodeProcess]:
        """The nodes of the process of a node, itself included, whose streams have not ended."""
        return [
            sharing
            for sharing in self
            if sharing.process is node.process and not sharing.ended
        ]

    def _start_again(self, dead: NodeProcess) -> None:
        """Start the nodes of a process that died, at their endpoints, and paused as they were."""
        due = [node for node in self if self.restarts[node.name].due_s is not None]
        nodes = [node for node in due if node.process is dead.process]
        specs = []
        for node in nodes:
            self._close(node)
            restarts = self.restarts[node.name]
            self._log(
                f"[launch] {node.name} is started again (restart {restarts.total})"
            )
            if node.state.get("paused"):
                self._to_pause.add(node.name)
            specs.append(node.spec.with_live(node.settings).again(restarts.total))
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
        for _ in range(5):  # more than a socket holds, then the end
            self._listen(node)
        for pipe in node.pipes:  # a child of the node's may still hold the other end
            if not node.closed and pipe in self._selector.get_map():
                self._selector.unregister(pipe)
        node.close()

    def _alive(self) -> list[NodeProcess]:
        return [node for node in self if node.exit_code() is None]

    def _check(self, node: NodeProcess, now_s: float) -> None:
        """Check whether a node has died or hangs."""
        code = node.exit_code()
        if code is None:
            hang_s = node.spec.restart.hang_s
            if hang_s and not node.ready:
                hang_s = max(
                    hang_s, START_S
                )  # to import and to open a device takes its time
            hung = bool(hang_s) and now_s - node.heard_s > hang_s
            if (
                self.supervised
                and hung
                and not node.ended
                and node.spec.restart.restarts
            ):
                nodes = self._companions(node)
                have = "has" if len(nodes) == 1 else "have"
                self._log(
                    f"[launch] {_names(nodes)} {have} been silent for {hang_s:g} s: SIGKILL"
                )
                node.send_signal(signal.SIGKILL)
                for companion in nodes:
                    companion.heard_s = now_s
        elif node.ended:
            if not node.closed:
                self._close(node)
        elif self.restarts[node.name].due_s is None:
            self._listen(node)
            if not node.ended and self.restarts[node.name].due_s is None:
                names = _names(self._companions(node))
                self._died(
                    node, EXIT_FAILED, f"{names} ended too early: {exit_text(code)}"
                )

    def _listen(self, node: NodeProcess) -> None:
        if node.closed:
            return
        events, log = node.read()
        for pipe in node.closed_pipes:
            if pipe in self._selector.get_map():
                self._selector.unregister(pipe)
        for line in log:
            self._log(f"[{node.name}] {line}")
        for event in events:
            self._take(node, event)

    def _take(self, node: NodeProcess, event: dict[str, Any]) -> None:
        for line in event.get("trace", "").splitlines():
            self._record(f"[{node.name}] {line}")
        match event["event"]:
            case "bound":
                node.endpoint = self._bound[node.name] = event["endpoint"]
                node.outputs = [
                    t for t in node.spec.outputs if t not in event["unused"]
                ]
                self._peers[node.name] = Peer(
                    node.name, node.endpoint, key=self._public
                )
                if self.supervised:
                    self.connect(node)
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
            case "failed":  # the node has logged the reason
                self._fail(node, EXIT_USAGE)
            case "error":
                self._died(node, event["code"], f"[{node.name}] error: {event['text']}")
                return
            case "raised":  # the node has logged the error, and goes on
                self.late_code = self.late_code or EXIT_FAILED
            case "answer":
                node.settings = event["settings"]
                node.state = event["state"]
            case _:
                self._log(f"[{node.name}] {event}")
        self.hear(node, event)

    def _died(self, failed: NodeProcess, code: int, text: str) -> None:
        """A process has ended before its time: start its nodes again, or end the graph with them.
        `failed` is the node that is known to have failed.
        """
        nodes = self._companions(failed)
        if failed not in nodes or self.restarts[failed.name].due_s is not None:
            return  # it has ended, or another node of its process has reported it
        for node in nodes:
            unfinished = node.spec.cls.left_behind(node.spec.settings)
            if unfinished:
                self.left.setdefault(node.name, []).append(unfinished)
        names = _names(nodes)
        why = text.removeprefix(f"[{failed.name}] ").removeprefix(f"{names} ")
        line = f"[launch] {text}"
        if text.startswith("["):
            companions = [node for node in nodes if node is not failed]
            line = text + (
                f" (of the same process: {_names(companions)})" if companions else ""
            )
        if self.supervised and code != EXIT_USAGE:
            # The nodes of a process have one policy, and fail together.
            for node in nodes:
                given_up = self.restarts[node.name].failed(awake_s(), why)
            if given_up is None:
                self._log(line)
                return
            line += given_up
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


def _names(nodes: Iterable[NodeProcess]) -> str:
    return ", ".join(node.name for node in nodes)
