"""From acquisition to reconstruction, also where the two happened on different hosts."""

from __future__ import annotations

from collections.abc import Callable

from sparseskin.messages import Reconstruction, Taxels
from sparseskin.messages.topics import topic_of
from sparseskin.nodes.clock_offset import SAME_CLOCK, ClockEstimate

ClockOf = Callable[[str], ClockEstimate | None]


def same_clock(topic: str) -> ClockEstimate:
    """For a graph on one host: all topics carry the stamps of one clock."""
    return SAME_CLOCK


class Delay:
    """Latency of reconstructions by the clock of the host that watches.

    Parameters
    ----------
    clock_of : callable
        Takes a topic; tells how far the clock of its writer is ahead, None while that is not
        known.

    Attributes
    ----------
    uncertainty_ns : int
        A latency may be wrong by this: the largest value of all so far; 0 on one host.
    """

    def __init__(self, clock_of: ClockOf) -> None:
        self._clock_of = clock_of
        self.uncertainty_ns = 0

    def of(self, message: Reconstruction) -> int | None:
        """Latency in ns; None while a clock is not known."""
        acquired = self._clock_of(topic_of(message.patch, Taxels.schema))
        restored = self._clock_of(topic_of(message.patch, Reconstruction.schema))
        if acquired is None or restored is None:
            return None
        if acquired is not restored:
            uncertainty_ns = acquired.uncertainty_ns + restored.uncertainty_ns
            self.uncertainty_ns = max(self.uncertainty_ns, uncertainty_ns)
        ahead_ns = restored.offset_ns - acquired.offset_ns
        return message.done_ns - message.stamp_ns - ahead_ns
