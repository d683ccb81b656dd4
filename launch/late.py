"""Who is late as a graph starts or ends, and what each one waits for."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence

from sparseskin.nodes.graph import Link

from .process import NodeProcess

SLOW_S = 5.0
"""How long a start may take before a line says what it waits for."""


def late_at_start(node: NodeProcess) -> str:
    """What a node that is not ready waits for; "" for one that is."""
    if node.ready:
        return ""
    if not node.endpoint:
        return f"{node.name} has not started: it imports, or opens its device"
    if node.lacks:
        return f"{node.name} waits for a subscription from {', '.join(node.lacks)}"
    return f"{node.name} has not answered yet"


def late_at_end(nodes: Iterable[NodeProcess], links: Sequence[Link]) -> list[str]:
    """The nodes that have not ended, each with those that it waits for: an end comes along the
    links, from the sources on.
    """
    late = [node.name for node in nodes if not node.ended]
    told = []
    for name in late:
        writers = sorted({ln.writer for ln in links if ln.reader == name and ln.writer in late})
        why = f"waits for {', '.join(writers)}" if writers else "has not ended its stream"
        told.append(f"{name} ({why})")
    return told


def or_tell(
    done: Callable[[], bool],
    nodes: Iterable[NodeProcess],
    log: Callable[[str], None],
    now_s: Callable[[], float] = time.monotonic,
) -> Callable[[], bool]:
    """As `done`; where it takes longer than `SLOW_S`, all who are late are named, once."""
    due_s = now_s() + SLOW_S
    told = False

    def check() -> bool:
        nonlocal told
        if done():
            return True
        if not told and now_s() >= due_s:
            told = True
            for line in filter(None, map(late_at_start, nodes)):
                log(f"[launch] {line} ({SLOW_S:g} s)")
        return False

    return check
