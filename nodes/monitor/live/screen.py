"""Live monitor as text, for a terminal of 80 columns."""

import textwrap
import time
from collections.abc import Iterable, Mapping
from typing import Any

from sparseskin.messages.reasons import phrase_of
from sparseskin.nodes.monitor.table import summary_table

from .feed import Feed
from .notices import BAD, START, Notice, Notices, host_lines

WIDTH = 79


def screen(feed: Feed, notices: Notices, status: str) -> str:
    """Notices, nodes and hosts, the status line and the figures of the page, as lines of at most 79
    characters.
    """
    with feed.changed:
        now_s = time.monotonic()
        graph = feed.graph or {}
        current = notices.all(now_s)

        # The graph: its name and state, its nodes, other hosts.
        lines = [_title(graph, current)]
        if graph.get("recording"):
            lines.append(f"recording {graph['recording']}")
        nodes = graph.get("nodes", [])
        states = []
        for node in nodes:
            states.append(f"{node['name']}: {node['condition']}")
        lines += textwrap.wrap(", ".join(states), WIDTH)
        lines += [text for _, text in host_lines(graph)]

        # What is wrong.
        for tone, text in current:
            mark = " *"
            if tone == BAD:
                mark = "!!"
            lines.append(f"{mark} {text}")
        for name, patch in feed.patches.items():
            if not patch.trusted(now_s):
                lines += _untrusted_lines(name, patch.reason)

        # What was measured.
        for line in status.split("\n"):
            lines += textwrap.wrap(line, WIDTH)
        summaries = {}
        for name, patch in feed.patches.items():
            if patch.summary:
                summaries[name] = patch.summary
        if summaries:
            name = graph.get("name", "")
            lines += summary_table(name, summaries).split("\n")
    return "\n".join(line[:WIDTH] for line in lines)


def _title(graph: Mapping[str, Any], current: Iterable[Notice]) -> str:
    """Name of the graph, and its state flush right."""
    tones = {tone for tone, _ in current}
    state = "live"
    if BAD in tones:
        state = "FAULT"
    elif START in tones:
        state = "starting"
    name = f"sparseskin  {graph.get('name', '')}"
    room = WIDTH - len(state)
    return name[: room - 2].ljust(room) + state


def _untrusted_lines(name: str, reason: str) -> list[str]:
    text = f"!! {name}: not trusted"
    if reason:
        text += f": {phrase_of(reason)}"
    return textwrap.wrap(text, WIDTH, subsequent_indent="   ")
