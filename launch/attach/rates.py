"""Rate, size and age of the messages of a topic: a line a second, and one over all at the end."""

import json
import sys
import time
from collections import deque
from itertools import islice

import numpy as np
import numpy.typing as npt

from sparseskin.launch.run.running import RunningGraph
from sparseskin.nodes.numerics.arrays import AnyArray
from sparseskin.nodes.process.control import Document

from .stream import Arrival, Display, Losses, quiet_reason
from .text import formatted, size_text

REPORT_S = 1.0
"""Time from one line to the next, seconds."""
WINDOW = 1000
"""Most messages that a line is over."""
MAX_KEPT = 100_000
"""Most messages that the figures at the end are over."""
Longs = npt.NDArray[np.int64]


class Samples:
    """Times and sizes of the `n` messages that came, and the number of those that did not."""

    def __init__(self) -> None:
        self.n = 0
        self._losses = Losses()
        self._kept: deque[tuple[int, int, int, int, bool]] = deque(maxlen=MAX_KEPT)

    @property
    def lost(self) -> int:
        return self._losses.n

    def add(self, arrival: Arrival) -> None:
        """Add one message."""
        if not self._losses.add(arrival):
            # Stamps and numbers of another run do not continue those before.
            self._kept.clear()
        if arrival.ends:
            return
        self.n += 1
        figures = (
            arrival.at_ns,
            arrival.stamp_ns,
            arrival.seq,
            arrival.n_bytes,
            arrival.fresh,
        )
        self._kept.append(figures)

    def last(self, window: int) -> Longs:
        """Time of arrival, stamp, number, size and freshness of the last messages of the
        publisher's present run, `window` at most: shape (n, 5).
        """
        n_before = max(0, len(self._kept) - window)
        rows = list(islice(self._kept, n_before, None))
        return np.array(rows, dtype=np.int64).reshape(-1, 5)


def figures_of(samples: Longs) -> Document:
    """Figures of messages, as `Samples.last` returns them: sent_hz, by the numbers and stamps;
    interval_ms between the stamps of messages with adjacent numbers; arrives_hz, the received
    messages over the span of the stamps; bytes_per_s and size_bytes, topic and payload; delay_ms
    from the stamp, the acquisition of the frame, to the arrival here, of fresh messages. Of
    distributions mean, min, max and std, of the delay p50 and p99 too. None where too few came.
    """
    at_ns, stamp_ns, seq, n_bytes, fresh = samples.T

    # Lost messages were sent, too: rates of sending count them.
    steps = np.diff(seq)
    # A gap of lost messages is no interval.
    adjacent_ns = np.diff(stamp_ns)[steps == 1]
    # One that has waited for this command would make the graph look slow.
    delays_ns = at_ns - stamp_ns
    delays_ms = delays_ns[fresh > 0] / 1e6
    delay = _extent(delays_ms)
    if delay is not None:
        p50, p99 = np.quantile(delays_ms, [0.5, 0.99])
        delay = {
            "p50": float(p50),
            "p99": float(p99),
            **delay,
        }

    each_counts_one = np.ones_like(steps)
    return {
        "sent_hz": _a_second(stamp_ns, steps),
        "interval_ms": _extent(adjacent_ns / 1e6),
        "arrives_hz": _a_second(stamp_ns, each_counts_one),
        "bytes_per_s": _a_second(stamp_ns, n_bytes[1:]),
        "size_bytes": _extent(n_bytes),
        "delay_ms": delay,
    }


def text_of(figures: Document) -> str:
    """The figures as part of a line; "" where there are none."""
    parts = []
    if figures["sent_hz"] is not None:
        sent_hz = figures["sent_hz"]
        arrives_hz = figures["arrives_hz"]
        parts.append(f"{sent_hz:.4g} Hz, {arrives_hz:.4g} here")
        parts.append(f"{size_text(figures['bytes_per_s'])}/s")
    delay = figures["delay_ms"]
    if delay is not None:
        parts.append(f"p50 {delay['p50']:.2f}, p99 {delay['p99']:.2f} ms old")
    return " | ".join(parts)


def _a_second(stamp_ns: Longs, amounts: Longs) -> float | None:
    """Amounts after the first stamp, per second of the publisher's time."""
    if not len(stamp_ns):
        return None
    # Messages are read in batches: their arrival times are no measure.
    span_ns = int(stamp_ns[-1] - stamp_ns[0])
    if span_ns <= 0:
        return None
    total = float(amounts.sum())
    return total * 1e9 / span_ns


def _extent(values: AnyArray) -> dict[str, float] | None:
    if not len(values):
        return None
    return {
        "mean": float(values.mean()),
        "min": float(values.min()),
        "max": float(values.max()),
        "std": float(values.std()),
    }


class Meter(Display):
    """Prints the figures of a topic, a line a second."""

    def __init__(self, graph: RunningGraph, topic: str, in_json: bool) -> None:
        self._graph = graph
        self._topic = topic
        self._in_json = in_json
        self._samples = Samples()
        self._reported_n = 0
        self._heard_s = time.monotonic()
        self._report_at_s = self._heard_s + REPORT_S

    def take(self, arrival: Arrival) -> bool:
        """Add a message; True if it counts."""
        self._samples.add(arrival)
        self._heard_s = time.monotonic()
        return not arrival.ends

    def tick(self) -> None:
        """Print a line where one is due."""
        now_s = time.monotonic()
        if now_s < self._report_at_s:
            return
        # Lines that were missed while this process stood still are not made up for.
        self._report_at_s = max(self._report_at_s, now_s - REPORT_S) + REPORT_S

        if self._samples.n > self._reported_n:
            self._reported_n = self._samples.n
            print(self._line(WINDOW), flush=True)
            return
        # Silence is reported, not left to be noticed.
        quiet = f"no message for {now_s - self._heard_s:.0f} s"
        why = quiet_reason(self._graph, self._topic)
        print(f"{self._topic}: {quiet}{why}", file=sys.stderr, flush=True)

    def finish(self) -> None:
        """Print a line over all messages."""
        print(self._line(None), flush=True)

    def _line(self, window: int | None) -> str:
        """The figures of the last `window` messages, or of all (None), as text or JSON."""
        samples = self._samples.last(window or MAX_KEPT)
        figures = figures_of(samples)
        n = self._samples.n
        lost = self._samples.lost
        if self._in_json:
            head = {
                "topic": self._topic,
                "messages": n,
                "lost": lost,
            }
            over = {"over": len(samples), "final": window is None}
            return json.dumps(
                formatted(
                    "topic-hz",
                    {
                        **head,
                        **figures,
                        **over,
                    },
                )
            )

        measured = text_of(figures) or "too few messages for a rate"
        line = f"{measured} | lost {lost}"
        if window is None:
            line = f"all {n}: {line}"
        return line
