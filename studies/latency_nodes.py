"""The shipped nodes with a stopwatch beside them: launch types of the study `latency` alone.

Each notes when a frame's message came to it and when what it made of it was sent. What it costs is
two looks at the clock and a list's append a frame, and the shipped nodes are as they are. The skins
are drivers that hand out frames from memory: no simulation takes processor time from the graph.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Measurements, Message, Reconstruction, Taxels
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.node import Tick
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.node import Sensor
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes import open_scene

Frames = Iterator[tuple[int, npt.NDArray[np.float32]]]

N_FRAMES = 2000
WATCH = "stopwatch"
"""The key under which a node reports [stamp_ns, ns from there until ...] of each frame."""


def path_40() -> Frames:
    """What the taxels read of PATH's first 2000 frames, again and again: (stamp in ns, N)."""
    return _looped("path_40")


def drag_wrench_64() -> Frames:
    """What the taxels read of DRAG_WRENCH_64's first 2000 frames, again and again."""
    return _looped("drag_wrench_64")


def _looped(scene: str) -> Frames:
    rng = np.random.default_rng(0)
    source = open_scene(scene, seed=0)
    noise = NoiseModel.for_range(source.skin.f_max)
    read = [noise.apply(forces, rng) for _, forces in itertools.islice(source, N_FRAMES)]
    for index, forces in enumerate(itertools.cycle(read)):
        yield index * 1_000_000, forces


class TimedSensor(Sensor):
    """A sensor that notes (stamp_ns, sent)."""

    def tick(self, tick: Tick) -> Iterable[Message]:
        for message in super().tick(tick):
            yield message  # it has been sent when the runner comes back for more
            if isinstance(message, Taxels):
                _note(self, message.stamp_ns, self.context.clock.now_ns())

    def report(self) -> dict[str, Any]:
        return {**super().report(), WATCH: _notes(self)}


class TimedCompressor(Compressor):
    """A compressor that notes (stamp_ns, came, sent)."""

    def step(self, message: Message) -> Iterable[Message]:
        came_ns = self.context.clock.now_ns()
        for made in super().step(message):
            yield made
            if isinstance(made, Measurements):
                _note(self, made.stamp_ns, came_ns, self.context.clock.now_ns())

    def report(self) -> dict[str, Any]:
        return {**super().report(), WATCH: _notes(self)}


class TimedReconstructor(Reconstructor):
    """A reconstructor that notes (stamp_ns, came, solver called, solved, sent)."""

    def step(self, message: Message) -> Iterable[Message]:
        came_ns = self.context.clock.now_ns()
        for made in super().step(message):
            yield made
            if isinstance(made, Reconstruction):
                begin_ns = made.done_ns - made.solve_ns
                sent_ns = self.context.clock.now_ns()
                _note(self, made.stamp_ns, came_ns, begin_ns, made.done_ns, sent_ns)

    def report(self) -> dict[str, Any]:
        return {**super().report(), WATCH: _notes(self)}


def _notes(node: Any) -> list[list[int]]:
    """The notes of a node; they begin with its first frame."""
    notes: list[list[int]] = node.__dict__.setdefault("notes", [])
    return notes


def _note(node: Any, stamp_ns: int, *times_ns: int) -> None:
    _notes(node).append([stamp_ns, *(time_ns - stamp_ns for time_ns in times_ns)])
