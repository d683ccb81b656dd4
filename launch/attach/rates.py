"""Rate, size and age of the messages of a topic: a line a second, and one over all at the end."""

from __future__ import annotations

import json
import sys
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.launch.run.running import RunningGraph

from .formats import formatted
from .stream import (
    EXIT_NOTHING,
    PATIENCE_S,
    Arrival,
    Losses,
    TopicStream,
    latched_note,
    quiet_reason,
)

REPORT_S = 1.0
"""Time from one line to the next, seconds."""
MAX_KEPT = 200_000
"""Most messages whose times are kept, for quantiles over the whole run."""

Longs = npt.NDArray[np.int64]


class Samples:
    """Times and sizes of the `n` messages that came, and the number of those that did not."""

    def __init__(self) -> None:
        self.n = 0
        self._losses = Losses()
        self._kept: dict[str, array[int]] = {
            key: array("q") for key in ("at_ns", "stamp_ns", "seq", "n_bytes")
        }
        self._run_begins = 0

    @property
    def lost(self) -> int:
        return self._losses.n

    def add(self, arrival: Arrival) -> None:
        """Add one message."""
        if not self._losses.add(arrival):
            self._run_begins = len(self._kept["at_ns"])
        if arrival.ends:
            return
        self.n += 1
        for key, column in self._kept.items():
            column.append(getattr(arrival, key))
        if len(self._kept["at_ns"]) > MAX_KEPT:
            for column in self._kept.values():
                del column[: MAX_KEPT // 2]
            self._run_begins = max(0, self._run_begins - MAX_KEPT // 2)

    def last(self, window: int) -> dict[str, Longs]:
        """Columns at_ns, stamp_ns, seq, n_bytes of the last messages of the publisher's present
        run, `window` at most.
        """
        n = min(window, len(self._kept["at_ns"]) - self._run_begins)
        return {
            key: np.array(column[len(column) - n :], dtype=np.int64)
            for key, column in self._kept.items()
        }


def hz_figures(kept: dict[str, Longs]) -> dict[str, Any]:
    """Rate at which messages are sent, by their numbers and stamps, and at which they arrive.

    Returns
    -------
    dict
        sent_hz; interval_ms between the stamps of messages with adjacent numbers: mean, min, max,
        std; arrives_hz, the received messages over the span of the stamps. None where too few
        came.
    """
    stamp_ns, seq = kept["stamp_ns"], kept["seq"]
    intervals_ms = np.diff(stamp_ns)[np.diff(seq) == 1] / 1e6
    return {
        "sent_hz": _a_second(stamp_ns, np.diff(seq)),
        "interval_ms": _extent(intervals_ms) if len(intervals_ms) else None,
        "arrives_hz": _a_second(stamp_ns, np.ones_like(seq[1:])),
    }


def bw_figures(kept: dict[str, Longs]) -> dict[str, Any]:
    """Bytes a second, and the size of a message, topic and payload."""
    sizes = kept["n_bytes"]
    return {
        "bytes_per_s": _a_second(kept["stamp_ns"], sizes[1:]),
        "size_bytes": _extent(sizes) if len(sizes) else None,
    }


def delay_figures(kept: dict[str, Longs]) -> dict[str, Any]:
    """Time from the stamp, the acquisition of the frame, to the arrival here."""
    delays_ms = (kept["at_ns"] - kept["stamp_ns"]) / 1e6
    if not len(delays_ms):
        return {"delay_ms": None}
    p50, p99 = np.quantile(delays_ms, [0.5, 0.99])
    return {"delay_ms": {"p50": float(p50), "p99": float(p99), **_extent(delays_ms)}}


def hz_text(figures: dict[str, Any]) -> str:
    """`hz_figures` as part of a line; "" where there are none."""
    if figures["sent_hz"] is None:
        return ""
    line = f"sent {figures['sent_hz']:.2f} Hz"
    if (between := figures["interval_ms"]) is not None:
        low, high, std = (between[key] for key in ("min", "max", "std"))
        line += f", interval {low:.2f}..{high:.2f}, std {std:.2f} ms"
    return f"{line} | arrives {figures['arrives_hz']:.2f} Hz"


def bw_text(figures: dict[str, Any]) -> str:
    """`bw_figures` as part of a line; "" where there are none."""
    if figures["bytes_per_s"] is None:
        return ""
    size = figures["size_bytes"]
    each = f"{size['mean']:.0f}"
    if size["min"] != size["max"]:
        each += f" ({size['min']:.0f}..{size['max']:.0f})"
    return f"{_bytes(figures['bytes_per_s'])}/s | {each} bytes a message"


def delay_text(figures: dict[str, Any]) -> str:
    """`delay_figures` as part of a line; "" where there are none."""
    delay = figures["delay_ms"]
    if delay is None:
        return ""
    return (
        f"delay p50 {delay['p50']:.2f}, p99 {delay['p99']:.2f}, max {delay['max']:.2f} ms"
        f" | mean {delay['mean']:.2f}, std {delay['std']:.2f} ms"
    )


def _a_second(stamp_ns: Longs, amounts: Longs) -> float | None:
    """Amounts after the first stamp, a second of the publisher's time: messages are read in
    batches, so their arrival times are no measure.
    """
    span_ns = int(stamp_ns[-1] - stamp_ns[0]) if len(stamp_ns) else 0
    return float(amounts.sum()) * 1e9 / span_ns if span_ns > 0 else None


def _extent(values: npt.NDArray[Any]) -> dict[str, float]:
    return {
        "mean": float(values.mean()),
        "min": float(values.min()),
        "max": float(values.max()),
        "std": float(values.std()),
    }


def _bytes(n: float) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if n >= size:
            return f"{n / size:.2f} {unit}"
    return f"{n:.0f} B"


@dataclass(frozen=True)
class Measure:
    """Figures of messages, and those as text.

    Attributes
    ----------
    format : str
        Name of the JSON's format.
    patience_s : float
        How long messages may wait to be read together, seconds, which saves processor time; 0 for
        a measure of the arrival itself, which does not yield the processor to the graph either.
    """

    figures: Callable[..., dict[str, Any]]
    text: Callable[[dict[str, Any]], str]
    patience_s: float
    format: str


MEASURES = {
    "hz": Measure(hz_figures, hz_text, PATIENCE_S, "topic-hz"),
    "bw": Measure(bw_figures, bw_text, PATIENCE_S, "topic-bw"),
    "delay": Measure(delay_figures, delay_text, 0.0, "topic-delay"),
}


def measure(
    graph: RunningGraph,
    topic: str,
    what: Measure,
    *,
    window: int,
    n: int | None,
    duration_s: float | None,
    in_json: bool,
) -> int:
    """Print the figures of a topic, each line over `window` messages at most, until `n` messages
    came, `duration_s` seconds are over or its stream ends; return the exit code.
    """
    samples = Samples()
    ended = False
    reported_n, heard_s = 0, time.monotonic()
    report_at_s = heard_s + REPORT_S

    def note(line: str) -> None:
        print(line, file=sys.stderr if in_json else sys.stdout, flush=True)

    # Of a stated number of messages, the last ones are not to wait for more.
    with TopicStream(graph, topic, what.patience_s if n is None else 0.0) as stream:
        for arrivals in stream.batches(duration_s):
            for arrival in arrivals:
                samples.add(arrival)
                ended = arrival.ends
                if ended or samples.n == n:
                    break
            if ended or samples.n == n:
                break
            now_s = time.monotonic()
            if arrivals:
                heard_s = now_s
            if now_s < report_at_s:
                continue
            report_at_s = max(report_at_s, now_s - REPORT_S) + REPORT_S
            if samples.n > reported_n:
                reported_n = samples.n
                print(_line(topic, what, samples, window, in_json), flush=True)
            else:
                quiet = f"no message for {now_s - heard_s:.0f} s"
                note(f"{topic}: {quiet}{quiet_reason(graph, topic)}")
    if ended:
        note(f"{topic}: the stream has ended")
    if samples.n and what.figures is delay_figures and (latched := latched_note(topic)):
        note(f"{topic}: the delay is the age of its last message{latched}")
    if not samples.n:
        print(f"{topic}: no message came{quiet_reason(graph, topic)}", file=sys.stderr)
        return EXIT_NOTHING
    print(_line(topic, what, samples, None, in_json), flush=True)
    return 0


def _line(topic: str, what: Measure, samples: Samples, window: int | None, in_json: bool) -> str:
    """The figures of the last `window` messages, or of all (None), as a line of text or JSON."""
    kept = samples.last(MAX_KEPT if window is None else window)
    figures = what.figures(kept)
    if in_json:
        counts = {"messages": samples.n, "lost": samples.lost}
        over = {"over": len(kept["seq"]), "final": window is None}
        return json.dumps(formatted(what.format, {"topic": topic, **counts, **figures, **over}))
    measured = what.text(figures) or "too few messages for a rate"
    line = f"{measured} | lost {samples.lost}"
    return f"all {samples.n}: {line}" if window is None else line
