"""The shipped nodes with a stopwatch: node types of the study `speed` alone.

Each notes when a frame's message came and when the message made from it had been sent, and the
processor time of its process then. That costs three readings of clocks and two list elements a
frame; the shipped nodes are not changed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

from sparseskin.messages import Measurements, Message, Reconstruction, Taxels
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.monitor.node import Monitor
from sparseskin.nodes.node import Context, Node, Tick
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.node import Sensor

WATCH = "stopwatch"
"""Key under which a node reports, for each frame, [stamp_ns, ns from there until ...]."""
PROCESSOR = "processor_ns"
"""Key under which a node reports the processor time of its process after each frame, ns."""


class _Timed(Node[Any]):
    def __init__(self, settings: Any, context: Context) -> None:
        super().__init__(settings, context)
        self._notes: list[list[int]] = []
        self._processor_ns: list[int] = []

    def _timed(
        self, step: Callable[[Any], Iterable[Message]], what: Any, timed: type[Message]
    ) -> Iterable[Message]:
        """Yield the messages of a step; note came, what `_inside` adds, and sent of one type."""
        came_ns = self.context.clock.now_ns()
        for message in step(what):
            # It has been sent when the runner asks for the next one.
            yield message
            if not isinstance(message, timed):
                continue
            sent_ns = self.context.clock.now_ns()
            times_ns = [*self._inside(message, came_ns), sent_ns]
            stamp_ns = message.stamp_ns
            since_ns = [time_ns - stamp_ns for time_ns in times_ns]
            self._notes.append([stamp_ns, *since_ns])
            self._processor_ns.append(time.process_time_ns())

    def _inside(self, message: Any, came_ns: int) -> tuple[int, ...]:
        return (came_ns,)

    def report(self) -> dict[str, Any]:
        report = super().report()
        report[WATCH] = self._notes
        report[PROCESSOR] = self._processor_ns
        return report


class TimedSensor(_Timed, Sensor):
    """A sensor that notes (stamp_ns, sent)."""

    def tick(self, tick: Tick) -> Iterable[Message]:
        return self._timed(super().tick, tick, Taxels)

    def _inside(self, message: Any, came_ns: int) -> tuple[int, ...]:
        return ()


class TimedCompressor(_Timed, Compressor):
    """A compressor that notes (stamp_ns, came, sent)."""

    def step(self, message: Message) -> Iterable[Message]:
        return self._timed(super().step, message, Measurements)


class TimedReconstructor(_Timed, Reconstructor):
    """A reconstructor that notes (stamp_ns, came, solver called, solved, sent)."""

    def step(self, message: Message) -> Iterable[Message]:
        return self._timed(super().step, message, Reconstruction)

    def _inside(self, message: Any, came_ns: int) -> tuple[int, ...]:
        called_ns = message.done_ns - message.solve_ns[0]
        return (came_ns, called_ns, message.done_ns)


class TimedMonitor(Monitor):
    """A monitor that notes the processor time of its process after each reconstruction."""

    def __init__(self, settings: Any, context: Context) -> None:
        super().__init__(settings, context)
        self._processor_ns: list[int] = []

    def step(self, message: Message) -> Iterable[Message]:
        yield from super().step(message)
        if isinstance(message, Reconstruction):
            self._processor_ns.append(time.process_time_ns())

    def report(self) -> dict[str, Any]:
        return {**super().report(), PROCESSOR: self._processor_ns}
