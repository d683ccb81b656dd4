"""Latency and processor time of a graph in turns, each with or without something beside it."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Message, Reconstruction
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.settings import PatchSettings, setting


@dataclass(frozen=True)
class LatenciesSettings(PatchSettings):
    """Settings of the node that notes latencies."""

    out: str = setting("latencies.npy", "file to write")


class Latencies(Node[LatenciesSettings]):
    """Notes the stamp of each frame and the time when it was reconstructed, int64, ns."""

    Settings = LatenciesSettings
    patience_s = 0.05  # the times are in the messages: they can wait, and cost less together

    def __init__(self, settings: LatenciesSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._times = array("q")

    @classmethod
    def inputs(cls, settings: LatenciesSettings) -> tuple[str, ...]:
        return (f"/{settings.patch}/reconstruction",)

    def step(self, message: Message) -> Iterable[Message]:
        assert isinstance(message, Reconstruction)
        self._times.extend((message.stamp_ns, message.done_ns))
        return ()

    def close(self, counts: dict[str, Any]) -> None:
        np.save(self.settings.out, np.array(self._times, dtype=np.int64).reshape(-1, 2))


LATENCIES = """
[nodes.latencies]
type = "sparseskin.studies.streaming.turns:Latencies"
"""
"""Lines for a launch file: the latencies are written to latencies.npy in its folder."""


@dataclass(frozen=True)
class Turn:
    """One period of time, ns on the graph's clock, and the processor time used in it."""

    way: str
    began_ns: int
    ended_ns: int
    cpu_s: float


def take_turn(way: str, settle_s: float, turn_s: float, cpu_s: Callable[[], float]) -> Turn:
    """Let the graph run for a while, after a pause; `cpu_s` gives the processor time so far."""
    time.sleep(settle_s)
    began_ns, began_cpu_s = time.time_ns(), cpu_s()
    time.sleep(turn_s)
    return Turn(way, began_ns, time.time_ns(), cpu_s() - began_cpu_s)


def latencies_ms(turns: Sequence[Turn], times_ns: npt.NDArray[np.int64]) -> list[Any]:
    """Latencies of the frames acquired in each turn, ms.

    Parameters
    ----------
    turns : sequence of Turn
    times_ns : ndarray of int64, shape (n_frames, 2)
        As `Latencies` writes them: stamp and time of the reconstruction of each frame.

    Returns
    -------
    list of ndarray of float64
        One array a turn, one element a frame.
    """
    stamps, done = times_ns.T
    return [
        (done - stamps)[(stamps >= turn.began_ns) & (stamps < turn.ended_ns)] / 1e6
        for turn in turns
    ]
