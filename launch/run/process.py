"""The nodes of one process as the launcher sees them: their pipes, their state, their end; and the
clock by which the silence of a node is measured.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import chain
from typing import Any

from sparseskin.launch.launchfile.spec import NodeSpec
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.process.control import Connection, Document
from sparseskin.nodes.process.tally import Tally

NEW_S = 8.0
"""Time that a log line is published as the latest one, seconds."""
SILENT_S = 1.6
"""Silence of three heartbeats, after which a node counts as not answering, seconds."""
CHUNK_BYTES = 65536
"""Most that is read of a pipe at once, which is all that a pipe holds."""
MAX_LINE_BYTES = 8192
"""Length at which a line without an end is broken."""
LOG_BYTES = 100_000
"""What a node may log in a second."""
LINE_BYTES = 100
"""What a line counts as beside its length."""


class LogLines:
    """Splits what a node writes to stderr into lines; a flood is cut, and what was cut counted."""

    def __init__(self) -> None:
        self._rest = b""
        self._since_s = float("-inf")
        self._left = 0
        self._n_cut = 0

    def take(self, chunk: bytes, now_s: float, at_end: bool = False) -> list[str]:
        """The lines that a chunk completes; at the end of the pipe, also one without an end."""
        complete = []
        # A new second, or the last chance to report what was cut.
        if at_end or now_s - self._since_s >= 1.0:
            if self._n_cut:
                complete.append(
                    f"{self._n_cut} lines were cut (more than {LOG_BYTES // 1000} kB a "
                    "second)"
                )
            self._since_s = now_s
            self._left = LOG_BYTES
            self._n_cut = 0

        *lines, self._rest = (self._rest + chunk).split(b"\n")
        # A library may print dots without an end.
        if at_end or len(self._rest) > MAX_LINE_BYTES:
            lines.append(self._rest)
            self._rest = b""
        for line in filter(None, lines):
            # The line that crosses the limit is still whole.
            if self._left > 0:
                self._left -= len(line) + LINE_BYTES
                complete.append(line.decode(errors="replace"))
            else:
                self._n_cut += 1
        return complete


class NodePipes:
    """What joins one node to the launcher: its channel, its log, the numbers of its messages.
    Raises OSError if no descriptor is free.
    """

    def __init__(self, spec: NodeSpec) -> None:
        self.channel, self._channel_of_node = socket.socketpair()
        log, log_of_node = os.pipe()
        self.log = os.fdopen(log, "rb", buffering=0)
        self._log_of_node = os.fdopen(log_of_node, "wb", buffering=0)
        os.set_blocking(log, False)
        self.tally = Tally(spec.outputs)

    @property
    def of_node(self) -> tuple[int, int]:
        """Descriptors of the node's ends of its channel and its log."""
        return self._channel_of_node.fileno(), self._log_of_node.fileno()

    def close_of_node(self) -> None:
        """Close the node's ends, once it has inherited them."""
        self._channel_of_node.close()
        self._log_of_node.close()


def start_process(
    nodes: Sequence[tuple[NodeSpec, Document]],
) -> list["NodeProcess"]:
    """Start one process for one node or several, each with the configuration that
    `sparseskin.nodes.process.run_node` expects.

    Raises SparseskinError if the system starts no process more.
    """
    names = [spec.name for spec, _ in nodes]
    # -P: a file of the user's that is named like a standard module must not shadow it.
    # The names at the end are for whoever lists processes.
    command = [sys.executable, "-P", "-m", "sparseskin.nodes.process.run_node", *names]
    # Nodes share the processors: threads of one would hold up the others.
    environment = {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        **os.environ,
    }
    try:
        with ExitStack() as inherited:
            pipes = [NodePipes(spec) for spec, _ in nodes]
            for each in pipes:
                # This process must not hold them: their end is the end of the node.
                inherited.callback(each.close_of_node)
            # Channel and log of the first node are those of the process.
            (channel, log), *channels = (each.of_node for each in pipes)
            tallies = [each.tally.fd for each in pipes]
            process = subprocess.Popen(
                command,
                stdin=channel,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=environment,
                pass_fds=[*tallies, *chain(*channels)],
            )
    except OSError as error:
        raise SparseskinError(
            f"{', '.join(names)}: cannot be started: {error.strerror}"
        ) from error

    started = []
    for (spec, config), each in zip(nodes, pipes, strict=True):
        companions = [name for name in names if name != spec.name]
        config = {**config, "companions": companions}
        if each is pipes[0]:
            config["channels"] = channels
        started.append(NodeProcess(spec, config, process, each))
    return started


class NodeProcess:
    """A node and the `process` that runs it, alone or beside others, in a session of its own, so
    that a Ctrl-C in the terminal reaches the launcher alone.
    """

    def __init__(
        self,
        spec: NodeSpec,
        config: Document,
        process: subprocess.Popen[bytes],
        pipes: NodePipes,
    ) -> None:
        self.spec = spec
        self.name = spec.name
        self.config = config
        self.process = process
        self._tally = pipes.tally
        self.endpoint = ""
        self.outputs = list(spec.outputs)
        self.ready = False
        self.ended = False
        self.failed = False
        self.compiled: tuple[int, int] | None = None
        """Numbers of loops that a node that starts has compiled, and of all; None: it does not."""
        self.lacks: list[str] = []
        self.heard: dict[str, bool] = {}
        self.clocks: dict[str, tuple[int, int]] = {}
        self.line = ""
        self.refusal = ""
        self.state: Document = {}
        self.settings: Document = spec.settings.live_values()
        self.heard_s = awake_s()
        self.counted: Document = {}
        self.earlier: Document = {}
        self.report: Document = {}
        self._said = ""
        self._said_s = 0.0
        self._lines = LogLines()
        self._channel = Connection(pipes.channel)
        self._log = pipes.log
        self.pipes = (pipes.channel, pipes.log)
        """Events and log lines, to be waited on."""
        self.closed_pipes: set[Any] = set()
        tally = [spec.outputs, self._tally.fd]
        self._channel.send({**config, "tally": tally})

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def condition(self) -> str:
        """Condition of the node, in a word or two."""
        if self.failed or (self.exit_code() is not None and not self.ended):
            return "failed"
        if self.ended:
            return "ended"
        if not self.ready:
            return "starting"
        if awake_s() - self.heard_s > SILENT_S:
            return "not answering"
        if self.state.get("paused"):
            return "paused"
        return "running"

    @property
    def said(self) -> str:
        """The last line of its log, while it is new."""
        if awake_s() - self._said_s >= NEW_S:
            return ""
        return self._said

    @property
    def counts(self) -> Document:
        """Counters of the node and of its `earlier` runs. Of a run that was killed, the numbers of
        messages published are exact; the others are those of its last heartbeat.
        """
        if not self.closed:
            self.counted["published"] = self._tally.counts()
        counts: Document = _added(self.earlier, self.counted)
        return counts

    @property
    def closed(self) -> bool:
        """True once its pipes are closed."""
        return self._log.closed

    def exit_code(self) -> int | None:
        """Exit code, negative for a signal; None while the process runs."""
        return self.process.poll()

    def command(self, command: str, **fields: Any) -> None:
        """Send a command; a process that is gone is noticed by its exit code."""
        self._channel.send({"command": command, **fields})

    def send_signal(self, number: signal.Signals) -> None:
        if self.exit_code() is None:
            self.process.send_signal(number)

    def read(self) -> tuple[list[Document], list[str]]:
        """Waiting (events, log lines): of each pipe a bounded part, for a flood has no end."""
        self._channel.flush()
        lines = self._channel.lines()
        if lines is None:
            self.closed_pipes.add(self.pipes[0])

        # Nothing read (None) is not the end of the pipe (b"").
        chunk = self._log.read(CHUNK_BYTES)
        if chunk == b"":
            self.closed_pipes.add(self._log)
        at_end = self._log in self.closed_pipes
        log = self._lines.take(chunk or b"", awake_s(), at_end)
        if log:
            self._said = log[-1]
            self._said_s = awake_s()

        if lines:
            self.heard_s = awake_s()
        events = []
        for line in filter(None, lines or ()):
            events.append(_event(line.decode(errors="replace")))
        return events, log

    def close(self) -> None:
        """Collect the process and close its pipes; what has not ended by now is killed."""
        self._channel.connection.close()
        self.send_signal(signal.SIGKILL)
        self.process.wait()
        if not self.closed:
            self.counted["published"] = self._tally.close()
        self._log.close()


def _event(line: str) -> Document:
    try:
        event = json.loads(line)
    except json.JSONDecodeError:
        event = None
    # A library of a node may write to any descriptor, JSON too.
    if not isinstance(event, dict) or not isinstance(event.get("event"), str):
        return {"event": "garbage", "text": line[:200]}
    return event


def _added(first: Any, second: Any) -> Any:
    """Sums of counters that have the same keys."""
    if not isinstance(first, dict):
        return first + second
    sums = {**first, **second}
    for key in first.keys() & second.keys():
        sums[key] = _added(first[key], second[key])
    return sums


def exit_text(code: int) -> str:
    """Meaning of an exit code, for a person."""
    if code < 0:
        return f"killed by {signal.Signals(-code).name}"
    return f"exit code {code}"


MAX_STEP_S = 1.0
"""Longest step of the clock; the loop of a launcher reads it ten times a second."""


class AwakeClock:
    """A monotonic clock, in seconds, that stands still while this process does: stopped, frozen
    with its container, or held up. The silence of others is measured by it, for what they sent
    meanwhile is still to be read. `now_s` is a clock that goes on.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._read_s = now_s()
        self._paused_s = 0.0

    def __call__(self) -> float:
        now_s = self._now_s()
        # A longer step means that this process stood still, not that others were silent.
        self._paused_s += max(0.0, now_s - self._read_s - MAX_STEP_S)
        self._read_s = now_s
        return now_s - self._paused_s


awake_s = AwakeClock()
"""The clock of the launcher in this process."""
