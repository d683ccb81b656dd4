"""Live monitor as text, for a terminal of 80 columns."""

from __future__ import annotations

import itertools
import math
import time
from typing import Any

import numpy as np

from sparseskin.messages import Reconstruction, Resultant, Taxels, Truth
from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.monitor.statistics import SPAN_S
from sparseskin.nodes.monitor.table import NONE, patch_table

from .feed import Feed, PatchFeed
from .notices import BAD, Notices, host_lines

WIDTH = 79
BARS = "▁▂▃▄▅▆▇█"
N_BARS = 48
MAPS = (Truth.schema, Taxels.schema, Reconstruction.schema)


def screen(feed: Feed, notices: Notices) -> str:
    """All numbers of the page, as lines of at most 79 characters."""
    with feed.changed:
        now_s = time.monotonic()
        found = notices.all(now_s)
        graph = feed.graph or {}
        live = "FAULT" if any(tone == BAD for tone, _ in found) else "live"
        head = f"sparseskin  {graph.get('name', '')}"
        lines = [f"{head[: WIDTH - len(live) - 2]:<{WIDTH - len(live)}}{live}"]
        if graph.get("recording"):
            lines.append(f"recording {graph['recording']}")
        states = [f"{node['name']}: {node['condition']}" for node in graph.get("nodes", [])]
        lines += _wrapped(states)
        lines += [text for _, text in host_lines(graph)]
        lines += [f"{'!!' if tone == BAD else ' *'} {text}" for tone, text in found]
        for name, patch in feed.patches.items():
            lines += _patch_lines(name, patch, now_s)
    return "\n".join(line[:WIDTH] for line in lines)


def _wrapped(parts: list[str]) -> list[str]:
    lines = [""]
    for part in parts:
        if lines[-1] and len(lines[-1]) + len(part) + 2 > WIDTH:
            lines.append("")
        lines[-1] += ("  " if lines[-1] else "") + part
    return lines


def _patch_lines(name: str, patch: PatchFeed, now_s: float) -> list[str]:
    if patch.skin is None or not patch.summary:
        return [f" {name} ".center(WIDTH, "-"), "no frame has arrived yet"]
    rows = patch.history.since(0)[1]
    rows = rows[rows[:, 0] > now_s - SPAN_S]
    rate = int(np.count_nonzero(rows[:, 0] > now_s - 1.0))
    lines = patch_table(name, patch.summary).split("\n")[:-1]
    lines.append(f"rate        {rate} Hz of {patch.skin.rate_hz:g} Hz requested")
    if not patch.trusted(now_s):
        lines.append("!! NOT TRUSTED NOW")
    lines += _map_lines(patch)
    lines.append(f"{'':<8} {f'means of the last {SPAN_S:g} s':<{N_BARS}}  least .. largest")
    for title, column, unit in (("PSNR", 2, "dB"), ("latency", 3, "ms")):
        line, low, high = _sparkline(rows, column, now_s)
        lines.append(f"{title:<8} {line}  {low} .. {high} {unit}")
    return lines


def _map_lines(patch: PatchFeed) -> list[str]:
    """Peak, total force and centre of pressure of each map."""
    skin = patch.skin
    assert skin is not None
    lines = [
        f"{'':<14}{f'peak ({skin.unit})':>12}{f'total ({skin.unit})':>14}   centre of pressure"
    ]
    for name in MAPS:
        forces = patch.maps.get(name)
        if forces is None:
            continue
        total, peak = float(forces.sum(dtype=np.float64)), float(forces.max())
        centre = "no contact"
        if peak > CONTACT_FRACTION * skin.f_max:
            row = float(forces.sum(1, dtype=np.float64) @ np.arange(skin.n_rows)) / total
            col = float(forces.sum(0, dtype=np.float64) @ np.arange(skin.n_cols)) / total
            centre = f"row {row:.1f}, column {col:.1f}"
        lines.append(f"{name:<14}{peak:>12.4g}{total:>14.4g}   {centre}")
    if patch.resultant is not None:
        lines.append(_resultant_line(patch.resultant))
    return lines


def _resultant_line(r: Resultant) -> str:
    """Total force and centre of pressure, estimated from the measurements alone."""
    total = f"{r.total:.4g} ± {r.total_sd:.2g}"
    centre = "no contact"
    if r.row is not None and r.col is not None:
        centre = f"row {r.row:.1f} ± {r.row_sd:.1f}, column {r.col:.1f} ± {r.col_sd:.1f}"
    return f"{'resultant':<26}{total:>14}   {centre}"


def _sparkline(rows: np.ndarray[Any, Any], column: int, now_s: float) -> tuple[str, str, str]:
    """Means of `N_BARS` parts of the last minute as bars; the lowest and the highest mean."""
    edges = now_s - SPAN_S * (1 - np.arange(N_BARS + 1) / N_BARS)
    means: list[float] = []
    for begin, end in itertools.pairwise(edges):
        values = rows[(rows[:, 0] > begin) & (rows[:, 0] <= end), column]
        means.append(float(values.mean()) if len(values) else math.nan)
    known = [value for value in means if math.isfinite(value)]
    if not known:
        return " " * len(means), NONE, NONE
    low, high = min(known), max(known)
    span = high - low or 1.0
    line = "".join(
        BARS[int((value - low) / span * (len(BARS) - 1))] if math.isfinite(value) else " "
        for value in means
    )
    return line, f"{low:.1f}", f"{high:.1f}"
