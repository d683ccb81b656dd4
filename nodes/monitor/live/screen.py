"""Live monitor as text, for a terminal of 80 columns."""

from __future__ import annotations

import time

import numpy as np

from sparseskin.messages import Resultant
from sparseskin.nodes.monitor.table import patch_table

from .feed import Feed, PatchFeed
from .notices import BAD, Notices, host_lines

WIDTH = 79


def screen(feed: Feed, notices: Notices) -> str:
    """The figures and notices of the page, as lines of at most 79 characters."""
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
    rate = int(np.count_nonzero(patch.history.since(0)[1][:, 0] > now_s - 1.0))
    lines = patch_table(name, patch.summary).split("\n")[:-1]
    lines.append(f"rate        {rate} Hz of {patch.skin.rate_hz:g} Hz requested")
    if not patch.trusted(now_s):
        lines.append("!! NOT TRUSTED NOW" + (f" ({patch.reason})" if patch.reason else ""))
    if patch.resultant is not None:
        lines.append(_resultant_line(patch.resultant))
    if (found := patch.contacts) is not None:
        forces = zip(found.id, found.total, found.total_sd, strict=True)
        each = ", ".join(f"{number}: {total:.3g} ± {sd:.2g}" for number, total, sd in forces)
        lines.append(f"{found.summary(patch.skin.unit):<26}{each}")
    return lines


def _resultant_line(r: Resultant) -> str:
    """Total force and centre of pressure, estimated from the measurements alone."""
    total = f"{r.total:.4g} ± {r.total_sd:.2g}"
    centre = "no contact"
    if r.row is not None and r.col is not None:
        centre = f"row {r.row:.1f} ± {r.row_sd:.1f}, column {r.col:.1f} ± {r.col_sd:.1f}"
    return f"{'resultant':<26}{total:>14}   {centre}"
