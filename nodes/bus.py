"""A graph in one process: the same nodes, connected by a queue instead of sockets."""

from collections import deque
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

from sparseskin.messages import Message

from .clock import Clock, SystemClock
from .errors import SparseskinError
from .graph import NodeSpecs, join
from .node import Context, Tick
from .node_host import NodeHost

LOCAL_RUN_ID = "0" * 16


class Bus:
    """Runs nodes in one process, as fast as possible. `clock` is by default a `SystemClock`; what
    nodes log is appended to `lines`. Raises SettingsError as `join`.

    >>> bus = Bus({"sensor": (Sensor, Sensor.Settings(source="scene:path_40")), ...})
    >>> bus.run(n_frames=100)
    >>> bus.reports()["monitor"]["patches"]["skin"]["psnr_db"]
    """

    def __init__(self, nodes: NodeSpecs, clock: Clock | None = None) -> None:
        self.clock: Clock = clock or SystemClock()
        self.lines: list[str] = []
        self.hosts: dict[str, NodeHost] = {}
        links = join(nodes)
        for name, (cls, settings) in nodes.items():
            log = partial(_log, self.lines, name)
            # Frames wait until the nodes are done: no source is live here.
            context = Context(name, self._clock_of(name), log, live=False)
            node = cls(settings, context)
            inputs = [link.topic for link in links if link.reader == name]
            self.hosts[name] = NodeHost(node, LOCAL_RUN_ID, log, inputs)

        self._readers: dict[str, list[NodeHost]] = {}
        for link in links:
            readers = self._readers.setdefault(link.topic, [])
            readers.append(self.hosts[link.reader])

        # All hosts are made before the first message: any of them may read it.
        self._queue: deque[Message] = deque()
        self._n_ticks = 0
        self._last_stamp_ns = -1
        for host in self.hosts.values():
            self._deliver(host.start())

    def run(self, n_frames: int | None = None) -> None:
        """Let the sources acquire `n_frames` frames each, or all they have; then end the stream."""
        for _ in self.frames(n_frames):
            pass

    def frames(self, n_frames: int | None = None) -> Iterator[list[Message]]:
        """As `run`, one frame at a time: yields all messages that the frame led to."""
        sources = [host for host in self.hosts.values() if host.is_source]
        done = 0
        while n_frames is None or done < n_frames:
            live = [host for host in sources if not host.finished]
            if not live:
                return

            # Stamps name frames, so they must differ even on a clock that stands still.
            next_ns = self._last_stamp_ns + 1
            self._last_stamp_ns = max(self.clock.now_ns(), next_ns)
            tick = Tick(self._last_stamp_ns, self._n_ticks)
            messages: list[Message] = []
            for host in live:
                messages += self._deliver(host.tick(tick))
            # A tick that found no frame is not counted as one.
            has_frame = all(getattr(host.node, "acquired", True) for host in live)
            if not messages and not has_frame:
                continue
            self._n_ticks += 1
            done += 1
            yield messages

        for host in sources:
            self._deliver(host.finish_frames(self._last_stamp_ns))

    def close(self) -> None:
        """Let the nodes finish their files; call it once, after the last frame."""
        for host in self.hosts.values():
            host.close()

    def check(self) -> None:
        """Raise SparseskinError if a node has failed, or has refused a message."""
        for name, host in self.hosts.items():
            if host.failure or host.refusal:
                raise SparseskinError(f"{name}: {host.failure or host.refusal}")

    def reports(self) -> dict[str, dict[str, Any]]:
        """Reports by node name, of the nodes that have one."""
        reports = {}
        for name, host in self.hosts.items():
            report = host.node.report()
            if report:
                reports[name] = report
        return reports

    def _deliver(self, messages: Iterable[Message]) -> list[Message]:
        """Deliver messages and all that follow from them, in order; return all of them."""
        delivered: list[Message] = []
        # What a message leads to comes before the next one: `messages` may be lazy, and its node
        # works on only then.
        for published in messages:
            self._queue.append(published)
            while self._queue:
                message = self._queue.popleft()
                delivered.append(message)
                for reader in self._readers.get(message.topic, ()):
                    self._queue.extend(reader.receive(message))
        return delivered

    def _clock_of(self, name: str) -> Clock:
        """The clock of a node."""
        return self.clock


def _log(lines: list[str], name: str, line: str) -> None:
    lines.append(f"[{name}] {line}")
