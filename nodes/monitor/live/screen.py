"""Live monitor as text, for a terminal of 80 columns."""

import textwrap
import time

from sparseskin.messages.reasons import phrase_of
from sparseskin.nodes.monitor.table import summary_table

from .feed import Feed
from .notices import BAD, START, Notices, host_lines

WIDTH = 79


def screen(feed: Feed, notices: Notices, status: str) -> str:
    """Notices, nodes and hosts, the status line and the figures of the page, as lines of at most 79
    characters.
    """
    with feed.changed:
        now_s = time.monotonic()
        found = notices.all(now_s)
        graph = feed.graph or {}
        tones = {tone for tone, _ in found}
        live = "FAULT" if BAD in tones else "starting" if START in tones else "live"
        head = f"sparseskin  {graph.get('name', '')}"
        lines = [f"{head[: WIDTH - len(live) - 2]:<{WIDTH - len(live)}}{live}"]
        lines += [f"recording {graph['recording']}"] if graph.get("recording") else []
        states = [f"{node['name']}: {node['condition']}" for node in graph.get("nodes", [])]
        lines += textwrap.wrap(", ".join(states), WIDTH)
        lines += [text for _, text in host_lines(graph)]
        lines += [f"{'!!' if tone == BAD else ' *'} {text}" for tone, text in found]
        for name, patch in feed.patches.items():
            if not patch.trusted(now_s):
                why = f": {phrase_of(patch.reason)}" if patch.reason else ""
                text = f"!! {name}: not trusted{why}"
                lines += textwrap.wrap(text, WIDTH, subsequent_indent="   ")
        lines += [part for line in status.split("\n") for part in textwrap.wrap(line, WIDTH)]
        if summaries := {name: p.summary for name, p in feed.patches.items() if p.summary}:
            lines += summary_table(summaries).split("\n")
    return "\n".join(line[:WIDTH] for line in lines)
