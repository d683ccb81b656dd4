"""Notices of faults and unusual states of a graph, and lines on its other hosts."""

import re
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

from sparseskin.messages import Reconstruction
from sparseskin.nodes.errors import counted

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
        current: list[Notice] = []
        # The monitor itself first: without it nothing below is up to date.
        silent_s = now_s - feed.pulse_s
        if silent_s > PULSE_S:
            current.append((BAD, f"The monitor has not responded for {ago(silent_s)}."))
        graph_age_s = now_s - feed.graph_came_s
        if feed.graph is not None and graph_age_s > GRAPH_S:
            age = ago(graph_age_s)
            current.append((BAD, f"No state of the nodes has arrived for {age}."))

        if feed.start is not None:
            current.append((START, feed.start.text))
        graph = feed.graph or {}
        for node in graph.get("nodes", []):
            current += self._of_node(node, now_s)
        if feed.start is not None:
            # No frame is expected yet.
            return current

        by_patch = {}
        for name, patch in feed.patches.items():
            by_patch[name] = list(self._of_patch(name, patch, now_s))
        return current + _grouped(by_patch)

    def _of_node(self, node: dict[str, Any], now_s: float) -> Iterator[Notice]:
        name = node["name"]
        condition = node["condition"]
        # Counted in each call, so that the window of the event begins when it comes.
        was_restarted = self._risen(f"restarts {name}", node["restarts"], now_s)
        starts_again = condition == "starting" and node["restarts"]
        if condition in TROUBLED or starts_again:
            yield BAD, f"{name}: {condition}."
        elif was_restarted:
            yield NOTE, f"{name} was restarted."

        n_refused = self._risen(f"refused {name}", node["refused"], now_s)
        if n_refused and node["refusal"]:
            yield BAD, f"{name} rejects messages: {node['refusal']}"
        if node["said"] and condition != "starting":
            yield NOTE, f"{name} reports: {node['said']}"
        if condition == "paused":
            yield NOTE, f"{name} is paused."

        state = node["state"]
        if state.get("left_out"):
            yield NOTE, f"{name}: {state['left_out']}."

    def _of_patch(self, name: str, patch: PatchFeed, now_s: float) -> Iterator[Notice]:
        if patch.ended:
            yield NOTE, "the stream has ended."
        elif not self._feed.paused:
            yield from _of_ages(patch, now_s)

        # A slow skin may take several frames' time without a queue.
        most_s = max(LATE_S, patch.stale_s)
        if patch.latency_s > most_s and not patch.ended:
            late = f"frames are reconstructed {ago(patch.latency_s)} late"
            yield BAD, f"{late}: the graph cannot keep up."
        n_lost = self._risen(f"lost {name}", patch.lost, now_s)
        if n_lost:
            yield BAD, f"{counted(n_lost, 'frame')} lost just now."

    def _risen(self, name: str, count: int, now_s: float) -> int:
        """Increase of a count within the last `RECENT_S`."""
        counts = self._seen.setdefault(name, deque())
        if not counts or count != counts[-1][1]:
            if counts and count < counts[-1][1]:
                # Another run of the node counts from 0.
                counts.clear()
            counts.append((now_s, count))

        begin_s = now_s - RECENT_S
        # The last count from before the window is the base of the increase.
        while len(counts) > 1 and counts[1][0] <= begin_s:
            counts.popleft()
        # Without a change within the window there is no increase to show.
        changed_s, _ = counts[-1]
        if changed_s <= begin_s:
            return 0
        _, base = counts[0]
        return count - base


def _of_ages(patch: PatchFeed, now_s: float) -> Iterator[Notice]:
    """Notices of a patch whose frames do not come, or are not reconstructed."""
    if not patch.came_s:
        yield NOTE, "no frame has arrived yet."
        return
    newest_s = now_s - max(patch.came_s.values())
    reconstructed_s = None
    if Reconstruction.schema in patch.came_s:
        reconstructed_s = now_s - patch.came_s[Reconstruction.schema]
    if newest_s > patch.stale_s:
        yield BAD, f"stale: no new frame for {ago(newest_s)}."
    elif reconstructed_s is None:
        # The first frame may still be under way.
        if patch.n_maps > 1:
            yield BAD, "frames are sensed, none is reconstructed."
    elif reconstructed_s > patch.stale_s:
        age = ago(reconstructed_s)
        yield BAD, f"stale: frames are sensed, none reconstructed for {age}."


def _grouped(by_patch: Mapping[str, list[Notice]]) -> list[Notice]:
    """Notices of all patches; of more than `FEW` that differ in numbers alone, the first."""
    if len(by_patch) == 1:
        return next(iter(by_patch.values()))

    kinds: dict[Notice, list[tuple[str, str]]] = {}
    for name, notices in by_patch.items():
        # Notices that differ in numbers alone are of one kind.
        for tone, text in notices:
            kind = (tone, re.sub(r"[0-9.]+", "#", text))
            kinds.setdefault(kind, []).append((name, text))

    grouped = []
    for (tone, _), of_kind in kinds.items():
        if len(of_kind) > FEW:
            name, text = of_kind[0]
            grouped.append(
                (tone, f"{name} and {len(of_kind) - 1} other patches: {text}")
            )
        else:
            grouped += [(tone, f"{name}: {text}") for name, text in of_kind]
    return grouped


def ago(seconds: float) -> str:
    """Text of a time span."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    return f"{seconds:.0f} s"


def host_lines(graph: Mapping[str, Any]) -> list[tuple[str, str]]:
    """A condition, "heard", "silent" or "unread", and a text for each other host of a graph."""
    lines = []
    for name, host in graph.get("hosts", {}).items():
        condition, text = _host_state(host)
        lines.append((condition, f"host {name}: {text}"))
    return lines


def _host_state(host: Mapping[str, Any]) -> tuple[str, str]:
    if host["silent"]:
        return SILENT, f"receives nothing from {', '.join(host['silent'])}"
    if not host["heard"]:
        return UNREAD, "nothing is read from it"
    within_ms = host["clock_uncertainty_ms"]
    if within_ms is None:
        return HEARD, "connected"
    return (
        HEARD,
        f"connected, clock {host['clock_offset_ms']:+.2f} ± {within_ms:.2f} ms",
    )
