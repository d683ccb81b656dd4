"""Figures of parts of a recording as plain data, and the summary of all of them together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from .metrics import PatchMetrics, TrustCount
from .statistics import Extent, Quantiles

_EXTENTS = (
    ("psnr_db", "noisy", "all"),
    ("psnr_db", "noisy", "contact"),
    ("psnr_db", "reconstruction", "all"),
    ("psnr_db", "reconstruction", "contact"),
    ("relative_error",),
)
_COUNTS = ("unchanged", "compared", "bytes_in", "bytes_out")
_TRUST = ("all", "contact")


def tally(metrics: PatchMetrics) -> dict[str, Any]:
    """Figures of one part of a recording, for JSON; `joined` makes a summary of several.

    The messages of the part carry their numbers in the whole recording.
    """
    trust = {"all": metrics.trust.every, "contact": metrics.trust.contact}
    return {
        "summary": metrics.summary(),
        "extents": [_of_extent(one) for one in _extents_of(metrics)],
        "trust": [[trust[name].n_frames, trust[name].n_untrusted] for name in _TRUST],
        "solve": metrics.solve.counted(),
    }


def joined(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The summary of a recording from the tallies of its parts, in their order: that of one pass.

    Raises ValueError, TypeError, KeyError or IndexError if they are no tallies.
    """
    found: dict[str, Any] = dict(parts[-1]["summary"])
    summaries = [part["summary"] for part in parts]
    # Numbers of frames go on from part to part.
    frames = dict(found["frames"])
    frames["unpaired"] = sum(int(one["frames"]["unpaired"]) for one in summaries)
    found["frames"] = frames
    found |= {name: sum(int(one[name]) for one in summaries) for name in _COUNTS}
    found["changes"] = [change for one in summaries for change in one["changes"]]
    found["psnr_db"] = {"noisy": {}, "reconstruction": {}}
    for k, path in enumerate(_EXTENTS):
        whole = _sum_of([part["extents"][k] for part in parts])
        place = found
        for name in path[:-1]:
            place = place[name]
        place[path[-1]] = whole.summary()
    found["trust"] = {
        name: _trust_of([part["trust"][k] for part in parts]) for k, name in enumerate(_TRUST)
    }
    solve = Quantiles()
    for part in parts:
        solve.add_counted(part["solve"])
    found["solve_ms"] = solve.summary()
    return found


def _extents_of(metrics: PatchMetrics) -> list[Extent]:
    noisy, reconstruction = metrics.noisy, metrics.reconstruction
    return [
        *(noisy.every, noisy.contact, reconstruction.every, reconstruction.contact),
        metrics.relative_error,
    ]


def _of_extent(one: Extent) -> list[float] | None:
    return [one.count, one.total, one.low, one.high] if one.count else None


def _sum_of(parts: Sequence[Sequence[float] | None]) -> Extent:
    known = [part for part in parts if part is not None]
    if not known:
        return Extent()
    counts, totals, lows, highs = zip(*known, strict=True)
    return Extent(int(sum(counts)), math.fsum(totals), min(lows), max(highs))


def _trust_of(parts: Sequence[Sequence[int]]) -> dict[str, Any] | None:
    n_frames, n_untrusted = (sum(numbers) for numbers in zip(*parts, strict=True))
    return TrustCount(n_frames, n_untrusted).summary()
