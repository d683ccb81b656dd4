"""Figures of parts of a recording as plain data, and the summary of all of them together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from .metrics import PatchMetrics, trust_summary
from .statistics import Extent, Quantiles

_PLACES = tuple(PatchMetrics().extents)
_COUNTS = ("unchanged", "compared", "bytes_in", "bytes_out")


def tally(metrics: PatchMetrics) -> dict[str, Any]:
    """Figures of one part of a recording, for JSON; `joined` makes a summary of several.

    The messages of the part carry their numbers in the whole recording.
    """
    extents = metrics.extents.values()
    return {
        "summary": metrics.summary(),
        "extents": [[e.count, e.total, e.low, e.high] if e.count else None for e in extents],
        "solve": metrics.solve.counted(),
    }


def joined(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The summary of a recording from the tallies of its parts, in their order: that of one pass.

    Raises ValueError, TypeError, KeyError or IndexError if they are no tallies.
    """
    summaries = [part["summary"] for part in parts]
    found: dict[str, Any] = dict(summaries[-1])  # numbers of frames go on from part to part
    unpaired = sum(int(one["frames"]["unpaired"]) for one in summaries)
    found["frames"] = {**found["frames"], "unpaired": unpaired}
    found |= {name: sum(int(one[name]) for one in summaries) for name in _COUNTS}
    found["changes"] = [change for one in summaries for change in one["changes"]]
    found |= {"psnr_db": {"noisy": {}, "reconstruction": {}}, "trust": {}}
    for k, (*outer, name) in enumerate(_PLACES):
        whole = _sum_of([part["extents"][k] for part in parts])
        place = found
        for key in outer:
            place = place[key]
        place[name] = trust_summary(whole) if outer == ["trust"] else whole.summary()
    solve = Quantiles()
    for part in parts:
        solve.add_counted(part["solve"])
    found["solve_ms"] = solve.summary()
    return found


def _sum_of(parts: Sequence[Sequence[float] | None]) -> Extent:
    known = [part for part in parts if part is not None]
    if not known:
        return Extent()
    counts, totals, lows, highs = zip(*known, strict=True)
    return Extent(int(sum(counts)), math.fsum(totals), min(lows), max(highs))
