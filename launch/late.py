"""Who is late as a graph starts or ends, and what each one waits for."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from sparseskin.nodes.graph import Link
from sparseskin.nodes.host import is_latched
from sparseskin.nodes.player.settings import PlayerSettings

from .process import NodeProcess

SLOW_S = 5.0
"""How long a start may take before a line says what it waits for."""
READER_S = 1.0
"""How long a player waits for its readers before a line says so."""


def late_at_start(node: NodeProcess) -> str:
    """What a node that is not ready waits for; "" for one that is."""
    if node.ready:
        return ""
    if not node.endpoint:
        return f"{node.name} has not started: it imports, or opens its device"
    if node.lacks:
        return f"{node.name} waits for a subscription from {', '.join(node.lacks)}"
    return f"{node.name} has not answered yet"


def slow_at_start(node: NodeProcess) -> str:
    """The same with how long it has taken by then."""
    line = late_at_start(node)
    return line and f"{line} ({SLOW_S:g} s)"


def lacks_readers(node: NodeProcess, graph: str) -> str:
    """What is to be done where a player of that graph waits for readers; "" where none does."""
    settings = node.spec.settings
    if not isinstance(settings, PlayerSettings) or node.ended or node.state.get("paused", True):
        return ""
    n_readers = settings.wait or int(settings.lockstep)
    published = node.counts.get("published", {})
    if not n_readers or any(n for topic, n in published.items() if not is_latched(topic)):
        return ""
    readers = "a reader" if n_readers == 1 else f"{n_readers} readers"
    return (
        f"{node.name} waits for {readers}; from another terminal: "
        f"sparseskin monitor --graph {graph}, or sparseskin record --graph {graph}"
    )


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


def taken_in(nodes: Iterable[NodeProcess]) -> Callable[[], bool]:
    """Whether all that came to some nodes has been taken in: each has ended, or its counts stand
    still over two heartbeats.
    """
    seen: dict[str, tuple[float, dict[str, Any], int]] = {}

    def check() -> bool:
        for node in nodes:
            heard_s, counts, n_same = seen.get(node.name, (node.heard_s, node.counts, 0))
            if node.heard_s != heard_s:
                n_same = n_same + 1 if node.counts == counts else 0
            seen[node.name] = (node.heard_s, node.counts, n_same)
        return all(node.ended or node.failed or seen[node.name][2] > 1 for node in nodes)

    return check


def or_tell(
    done: Callable[[], bool],
    nodes: Iterable[NodeProcess],
    log: Callable[[str], None],
    now_s: Callable[[], float] = time.monotonic,
    late: Callable[[NodeProcess], str] = slow_at_start,
    slow_s: float = SLOW_S,
) -> Callable[[], bool]:
    """As `done`; where it takes longer than `slow_s`, all who are late are named, once."""
    due_s = now_s() + slow_s
    told = False

    def check() -> bool:
        nonlocal told
        if done():
            return True
        if not told and now_s() >= due_s:
            for line in filter(None, map(late, nodes)):
                told = True
                log(f"[launch] {line}")
        return False

    return check
