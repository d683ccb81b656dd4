"""Notices of faults and unusual states of a graph, and lines on its other hosts."""

import math
import re
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

from sparseskin.messages import Reconstruction

from .feed import Feed, PatchFeed

BAD = "bad"
NOTE = "note"
START = "start"
HEARD = "heard"
SILENT = "silent"
UNREAD = "unread"
RECENT_S = 4.0
"""Time in seconds for which an event is shown."""
GRAPH_S = 2.5
"""Age in seconds beyond which the state of the graph is out of date."""
PULSE_S = 1.0
"""Age in seconds beyond which the monitor's own loop is overloaded."""
LATE_S = 0.5
"""Latency in seconds that only a growing queue causes, no solver."""
TROUBLED = ("failed", "not answering", "restarting")

Notice = tuple[str, str]
"""Tone, "bad", "note" or "start", and text."""
FEW = 4
"""Most patches whose notices of one kind are shown one by one."""


class Notices:
    """Current faults and recent events; the caller of `all` holds `feed.changed`."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self._seen: dict[str, deque[tuple[float, int]]] = {}

    def all(self, now_s: float) -> list[Notice]:
        """All notices, the worst of each kind first; `now_s` by time.monotonic()."""
        feed = self._feed
        found: list[Notice] = []
        if now_s - feed.pulse_s > PULSE_S:
            found.append((BAD, f"The monitor has not responded for {ago(now_s - feed.pulse_s)}."))
        if feed.graph is not None and now_s - feed.graph_came_s > GRAPH_S:
            age = ago(now_s - feed.graph_came_s)
            found.append((BAD, f"No state of the nodes has arrived for {age}."))
        if (start := feed.start) is not None:
            found.append((START, start.text))
        for node in (feed.graph or {}).get("nodes", []):
            found += self._of_node(node, now_s)
        if start is not None:
            return found
        by_patch = {name: [*self._of_patch(name, p, now_s)] for name, p in feed.patches.items()}
        return found + _grouped(by_patch)

    def _of_node(self, node: dict[str, Any], now_s: float) -> Iterator[Notice]:
        name = node["name"]
        condition = node["condition"]
        restarted = self._risen(f"restarts {name}", node["restarts"], now_s)
        if condition in TROUBLED or (condition == "starting" and node["restarts"]):
            yield BAD, f"{name}: {condition}."
        elif restarted:
            yield NOTE, f"{name} was restarted."
        if self._risen(f"refused {name}", node["refused"], now_s) and node["refusal"]:
            yield BAD, f"{name} rejects messages: {node['refusal']}"
        if node["said"] and condition != "starting":
            yield NOTE, f"{name} reports: {node['said']}"
        if condition == "paused":
            yield NOTE, f"{name} is paused."
        if node["state"].get("left_out"):
            yield NOTE, f"{name}: {node['state']['left_out']}."
        if node["state"].get("swamped"):
            yield BAD, f"{name}: too many measurements are inconsistent."

    def _of_patch(self, name: str, patch: PatchFeed, now_s: float) -> Iterator[Notice]:
        if patch.ended:
            yield NOTE, "the stream has ended."
        elif not self._feed.paused and patch.came_s:
            ages = {key: now_s - came_s for key, came_s in patch.came_s.items()}
            newest = min(ages.values())
            age_s = ages.get(Reconstruction.schema, math.inf)
            if newest > patch.stale_s:
                yield BAD, f"stale: no new frame for {ago(newest)}."
            elif math.isinf(age_s):
                if patch.n_maps > 1:
                    yield BAD, "frames are sensed, none is reconstructed."
            elif age_s > patch.stale_s:
                yield BAD, f"stale: frames are sensed, none reconstructed for {ago(age_s)}."
        elif not self._feed.paused:
            yield NOTE, "no frame has arrived yet."
        if patch.latency_s > max(LATE_S, patch.stale_s) and not patch.ended:
            late = ago(patch.latency_s)
            yield BAD, f"frames are reconstructed {late} late: the graph cannot keep up."
        lost = self._risen(f"lost {name}", patch.lost, now_s)
        if lost:
            yield BAD, f"{lost} frame{'s' if lost > 1 else ''} lost just now."

    def _risen(self, name: str, count: int, now_s: float) -> int:
        """Increase of a count within the last `RECENT_S`."""
        seen = self._seen.setdefault(name, deque())
        if not seen or count != seen[-1][1]:
            if seen and count < seen[-1][1]:
                seen.clear()  # another run of the node counts from 0
            seen.append((now_s, count))
        # The last count from before the window is the base of the increase.
        while len(seen) > 1 and seen[1][0] <= now_s - RECENT_S:
            seen.popleft()
        return count - seen[0][1] if seen[-1][0] > now_s - RECENT_S else 0


def _grouped(by_patch: Mapping[str, list[Notice]]) -> list[Notice]:
    """Notices of all patches; of more than `FEW` that differ in numbers alone, the first."""
    if len(by_patch) == 1:
        return next(iter(by_patch.values()))
    kinds: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for name, notices in by_patch.items():
        for tone, text in notices:
            kinds.setdefault((tone, re.sub(r"[0-9.]+", "#", text)), []).append((name, text))
    found = []
    for (tone, _), those in kinds.items():
        if len(those) > FEW:
            name, text = those[0]
            found.append((tone, f"{name} and {len(those) - 1} other patches: {text}"))
        else:
            found += [(tone, f"{name}: {text}") for name, text in those]
    return found


def ago(seconds: float) -> str:
    """Text of a time span."""
    return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"


def host_lines(graph: Mapping[str, Any]) -> list[tuple[str, str]]:
    """A condition, "heard", "silent" or "unread", and a text for each other host of a graph."""
    found = []
    for name, host in graph.get("hosts", {}).items():
        condition = HEARD
        text = "connected"
        if host["silent"]:
            condition = SILENT
            text = f"receives nothing from {', '.join(host['silent'])}"
        elif not host["heard"]:
            condition = UNREAD
            text = "nothing is read from it"
        elif (within_ms := host["clock_uncertainty_ms"]) is not None:
            text += f", clock {host['clock_offset_ms']:+.2f} ± {within_ms:.2f} ms"
        found.append((condition, f"host {name}: {text}"))
    return found
