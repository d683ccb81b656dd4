"""What messages of a topic are measured by: how often they come, how large, how old."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np
import numpy.typing as npt

from .topic_stream import Arrival, Losses

MAX_KEPT = 200_000
"""Messages whose times are kept, for quantiles over the whole run."""

Longs = npt.NDArray[np.int64]


class Samples:
    """Times and sizes of the messages that came.

    Attributes
    ----------
    n : int
        Messages that came.
    lost : int
        Messages that did not, as their numbers tell.
    """

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
        """Take one message in."""
        if not self._losses.take(arrival):
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
        """The last messages of the publisher's present run, `window` at most."""
        n = min(window, len(self._kept["at_ns"]) - self._run_begins)
        return {
            key: np.array(column[len(column) - n :], dtype=np.int64)
            for key, column in self._kept.items()
        }


def hz_figures(kept: dict[str, Longs]) -> dict[str, Any]:
    """How often messages are sent, as their numbers and stamps tell, and how many of them arrive.

    Parameters
    ----------
    kept : dict
        From `Samples.last`.

    Returns
    -------
    dict
        sent_hz; interval_ms between the stamps of messages with adjacent numbers: mean, min, max,
        std; arrives_hz, of what is sent a second, what comes. None each where too few came.
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
    """What came after the first stamp, a second: of the publisher's, for messages are taken in
    together, and later where this process had to give way.
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
