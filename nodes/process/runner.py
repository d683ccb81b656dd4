"""A node in a process: its sockets, the handshake with the launcher, its ticks."""

import json
import secrets
import threading
import time
from collections import deque
from collections.abc import Container, Iterable, Iterator
from typing import Any, TextIO

import zmq

from sparseskin.messages import Message
from sparseskin.nodes.clock import SystemClock
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.lookup import one_line, search_in, trace_of
from sparseskin.nodes.network.network import Network
from sparseskin.nodes.network.sockets import Peer, Reader, Writer
from sparseskin.nodes.node import Context, SourceNode, Tick
from sparseskin.nodes.node_host import NodeHost
from sparseskin.nodes.registry import node_class

from .control import Control, ControlClient
from .memory import FreeMemory
from .scheduling import Scheduling
from .tally import Tally

HEARTBEAT_NS = 500_000_000
BATCH = 64
"""Largest number of messages or ticks between two checks for commands."""
BATCH_NS = 50_000_000
"""Time after which none is begun before that check: a frame may take a second."""

EXIT_CRASH = 1
EXIT_USAGE = 2


class Runner:
    """One node in this process, which a `Loop` serves; `log_file` takes its log lines.

    `config` has name, type, settings, endpoint, inputs (topics), readers (names of the nodes that
    read this one), offset_ns (of the graph's clock); optional max_frames (of a source), folder (in
    which modules are searched too), late (the node joins a running graph), control (path of the
    control socket, of a node that watches its graph), page_token, page_file, tally (arguments of a
    `Tally`), cpus and priority (`Scheduling`), companions (names of the other nodes of the process,
    which share `Scheduling`), and the keys of `Network`.
    """

    network: Network
    writer: Writer

    def __init__(
        self, control: Control, config: dict[str, Any], log_file: TextIO
    ) -> None:
        self.control = control
        self.log_file = log_file
        self._config = config
        self._companions = bool(config.get("companions"))
        self.name: str = config["name"]
        self.clock = SystemClock(config["offset_ns"])
        self.host = self._make_host(config)
        self.streams = frozenset(topic.encode() for topic in self.host.streams)
        self._control_fd = control.connection.fileno()
        self.host.raised = lambda error: control.emit("raised", trace=trace_of(error))
        tally = config.get("tally")
        if tally:
            self.host.published = Tally(*tally).set

        self.expected = set(config["readers"])
        self.max_frames: int | None = config.get("max_frames")
        self.scheduling = Scheduling(
            tuple(config.get("cpus", ())), config.get("priority", 0)
        )
        self._begin()

    def _make_host(self, config: dict[str, Any]) -> NodeHost:
        """Make the node, with a run id of its own."""
        folder = config.get("folder")
        if folder:
            search_in(folder)
        cls = node_class(config["type"])
        settings = cls.Settings.from_mapping(config["settings"])
        late = bool(config.get("late"))
        context = Context(
            self.name,
            self.clock,
            self.log,
            self._ask,
            late,
            # The network is there once the sockets are open: a node is made before.
            clock_of=lambda topic: self.network.clock_of(topic),
            page_token=config.get("page_token", ""),
            page_file=config.get("page_file", ""),
            count=lambda done, of: self.control.emit("compiled", done=done, of=of),
        )
        return NodeHost(
            cls(settings, context),
            secrets.token_hex(8),
            self.log,
            config["inputs"],
            late,
            config.get("distant_inputs", ()),
        )

    def _begin(self) -> None:
        """Set the state of a node that has neither sockets nor readers yet."""
        self.reader: Reader | None = None
        self.client: ControlClient | None = None
        # A node may ask from threads of its own, as those of a page.
        self.client_lock = threading.Lock()
        self.connected = False
        self.ready = False
        self.started = False
        self.begun = False
        self.draining = False
        self.stopping = False
        self.end_reported = False
        self.failed = False
        self.terminated = False
        # Asks of this node that its readers have not answered; and those of its writers, each with
        # the ask of its own that has to be answered first.
        self.asks: deque[int] = deque()
        self.unanswered: deque[tuple[int, bytes]] = deque()
        self.caught_up = True
        self.memory: FreeMemory | None = None
        self.asked = False
        self.n_ticks = 0
        self.next_heartbeat_ns = 0
        self.last_stamp_ns = -1

    def log(self, line: str) -> None:
        """Print one line for the launcher's terminal."""
        print(line, file=self.log_file, flush=True)

    def open(
        self,
        context: zmq.Context[Any],
        poller: zmq.Poller,
        first: "Runner | None" = None,
    ) -> None:
        """Open the sockets of the node; `first` is the first node of the process, if another."""
        config = self._config
        of_first = first.network if first is not None else None
        self.network = Network(
            context, config, self.clock.now_ns, self.log, poller, of_first
        )
        self.writer = self.network.writer
        poller.register(self.control.connection.fileno(), zmq.POLLIN)
        # Memory is that of the process: one of its nodes returns what is free.
        if first is None:
            self.memory = FreeMemory()
        path = config.get("control")
        if path:
            self.client = ControlClient(path)
            self.client.send({"watch": True})
            poller.register(self.client.connection.fileno(), zmq.POLLIN)

    def _ask(self, request: dict[str, Any]) -> None:
        with self.client_lock:
            if self.client is not None:
                self.client.send(request)

    def _hear(self, client: ControlClient) -> None:
        """Pass the state of the graph, and answers, on to the node."""
        with self.client_lock:
            news = client.receive()
            # The launcher has ended.
            if news is None:
                self.network.poller.unregister(client.connection.fileno())
                client.close()
                self.client = None
        for fields in news or ():
            for name, value in fields.items():
                self._command(name, value, None)

    def start(self) -> None:
        """Name the endpoint of the node to the launcher, and publish its first messages."""
        self.control.emit(
            "bound", endpoint=self.writer.endpoint, unused=self.host.node.unused
        )
        self._publish(self.host.start())

    def serve(self, ready: Container[Any]) -> None:
        """Do all that is to be done now; `ready` are the sockets and files that can be read."""
        # The states for a new reader come before frames.
        if self.writer.socket in ready:
            self.writer.serve_subscriptions()
        if self.reader is not None and self._has_waiting(self.reader, ready):
            self._receive(self.reader)
        if self.unanswered:
            self._answer()
        if self._control_fd in ready:
            self._execute_commands()
        if self.client is not None and self.client.connection.fileno() in ready:
            self._hear(self.client)
        if self.draining and self._source is not None:
            self._publish(self.host.finish(max(0, self.last_stamp_ns)))
        self.network.serve()
        if self.host.is_source:
            self._tick_while_due()
        self.host.idle()
        self._report()

    def _tick_while_due(self) -> None:
        # Asked again after each tick: its readers may set the pace.
        for _ in _batch():
            due_in_ns = self.left_ns()
            if due_in_ns is None or due_in_ns > 0:
                return
            self._tick()

    def _has_waiting(self, reader: Reader, ready: Container[Any]) -> bool:
        """True if messages wait; those of a companion may have come since the loop has looked."""
        if reader.socket in ready or not self.caught_up:
            return True
        return self._companions and reader.has_waiting

    @property
    def over(self) -> bool:
        """True once the launcher has sent "stop" or has ended."""
        return self.stopping or self.control.closed

    def terminate(self) -> None:
        """End the node by SIGTERM."""
        self.terminated = not self.stopping
        self.stopping = True

    def finish(self) -> None:
        """Report the end of the node; no writer is to wait for it."""
        if self.terminated:
            self.control.emit("error", text="terminated (SIGTERM)", code=EXIT_CRASH)
        if not self.end_reported:
            self._report_end()
        for _, note in self.unanswered:
            assert self.reader is not None
            self.reader.answer(note)

    @property
    def patience_s(self) -> float:
        """Time for which messages may wait, s; 0 if a source waits for answers or times."""
        if self.asked or self.network.awaits_time:
            return 0.0
        return self.host.node.patience_s

    @property
    def _source(self) -> SourceNode[Any] | None:
        """The node, if it is a source that may tick."""
        node = self.host.node
        if self.started and isinstance(node, SourceNode) and not self.host.finished:
            return node
        return None

    def left_ns(self) -> int | None:
        """Time until the next tick; None if an event must come first."""
        source = self._source
        if source is None or len(self.writer.present) < source.min_readers:
            return None
        while self.asks and not self.writer.awaits(self.asks[0]):
            self.asks.popleft()
        # The first ask is that of the states: no frame comes before it is answered.
        window = source.window if self.begun else 1
        if len(self.asks) >= window:
            return None
        if not self.begun:
            source.begin(self.clock.now_ns())
            self.begun = True
        due_ns = source.next_tick_ns()
        if due_ns is None:
            return None
        return due_ns - self.clock.now_ns()

    def _execute_commands(self) -> None:
        for command in self.control.commands():
            match command["command"]:
                case "connect":
                    self._connect([Peer(**peer) for peer in command["peers"]])
                case "start":
                    if self.host.is_source:
                        # Its frames begin once the states are processed: solvers are made.
                        self.asks.append(self.writer.ask())
                    self.started = True
                case "drain":
                    self.draining = True
                case "stop":
                    self.stopping = True
                case name:
                    self._command(name, command.get("value"), command.get("id"))

    def _command(self, name: str, value: Any, number: str | None) -> None:
        """Execute a command of an operator, and answer it where it has a number."""
        node = self.host.node
        done = False
        try:
            text = self._executed(name, value)
            done = True
        except SparseskinError as error:
            text = str(error)
        # A user's own solver may raise anything.
        except Exception as error:
            text = one_line(error)
        if number is not None:
            state = {"settings": node.settings.live_values(), "state": node.state()}
            self.control.emit("answer", id=number, done=done, text=text, **state)
        elif not done:
            self.log(text)

    def _executed(self, name: str, value: Any) -> str:
        """Result of a command in words."""
        if name != "set":
            return self.host.node.command(name, value)
        self._publish(self.host.change(value))
        changes = []
        for key, changed in value.items():
            change = f"{key} = {json.dumps(changed)}"
            if changed is None:
                change = f"{key} is no longer stated"
            changes.append(change)
        return ", ".join(changes)

    def _connect(self, peers: list[Peer]) -> None:
        """Connect to writers; those on other hosts are named once this node is ready."""
        if peers and self.reader is None:
            host = self.host
            self.reader = self.network.make_reader(host.inputs, host.node.observes)
        if self.reader is not None:
            self.network.connect(peers)
        self.connected = True

    def _receive(self, reader: Reader) -> None:
        for _ in _batch():
            waiting = reader.take(self.host.node.depth, self.streams)
            self.caught_up = waiting is None
            if waiting is None:
                return
            topic, payload, overtaken = waiting
            if not reader.is_ask(topic):
                self._publish(self.host.receive_bytes(topic, payload, overtaken))
                continue
            note = bytes(payload)
            # An ask is passed on: it is answered once the readers of this node have answered.
            if not self.network.take_time(note):
                self.asked = True
                self.unanswered.append((self.writer.ask(), note))

    def _answer(self) -> None:
        """Answer asks as soon as the readers of this node have answered them."""
        while self.unanswered and not self.writer.awaits(self.unanswered[0][0]):
            assert self.reader is not None
            self.reader.answer(self.unanswered.popleft()[1])

    def _tick(self) -> None:
        # Stamps name frames: they increase, even where the clock does not.
        stamp_ns = max(self.clock.now_ns(), self.last_stamp_ns + 1)
        self.last_stamp_ns = stamp_ns
        n_sent = self._publish(self.host.tick(Tick(stamp_ns, self.n_ticks)))
        node = self.host.node
        assert isinstance(node, SourceNode)
        if not node.acquired:
            return
        # A driver may end at a tick that has no frame any more.
        self.n_ticks += not node.exhausted or n_sent > len(self.host.ends)
        source = self._source
        if source is not None and source.follows_readers:
            self.asks.append(self.writer.ask())
        if self.max_frames is None:
            return
        if self.n_ticks >= self.max_frames:
            self._publish(self.host.finish_frames(stamp_ns))
        elif node.exhausted:
            self.log(
                f"the source ended after {self.n_ticks} of the {self.max_frames} frames"
            )

    def _publish(self, messages: Iterable[Message]) -> int:
        """Send messages; return their number."""
        n_sent = 0
        for message in messages:
            self.writer.send(message)
            n_sent += 1
        return n_sent

    def _report(self) -> None:
        """Send events to the launcher: ready, heartbeat, failure, end."""
        if not self.ready and self.connected and self.expected <= self.writer.present:
            self.ready = True
            self.control.emit("ready")
        now_ns = time.monotonic_ns()
        if now_ns >= self.next_heartbeat_ns:
            self.next_heartbeat_ns = now_ns + HEARTBEAT_NS
            if self.memory is not None and self.caught_up:
                self.memory.trim()
            # Where readers are far behind, an end can be dropped too: it is repeated.
            self._publish(self.host.ends)
            self.network.end_repeated()
            lacks = [] if self.ready else sorted(self.expected - self.writer.present)
            self.control.emit(
                "heartbeat",
                lacks=lacks,
                line=self.host.node.status(),
                state=self.host.node.state(),
                refusal=self.host.refusal,
                counts=self.host.counts.as_dict(),
                heard=self.network.heard,
                clocks=self.network.clocks(),
            )
        if self.host.failure and not self.failed:
            self.failed = True
            self.control.emit("failed")
        if self.host.finished and not self.end_reported and self.network.end_received():
            self._report_end()

    def _report_end(self) -> None:
        self.end_reported = True
        self.host.close()
        self.control.emit(
            "ended",
            report=self.host.node.report(),
            counts=self.host.counts.as_dict(),
            failure=self.host.failure,
            clocks=self.network.clocks(),
        )


def _batch() -> Iterator[int]:
    """Count messages or ticks, to `BATCH` or until `BATCH_NS` are over."""
    end_ns = time.monotonic_ns() + BATCH_NS
    for k in range(BATCH):
        yield k
        if time.monotonic_ns() >= end_ns:
            return
