"""Nodes that are late as a graph starts or ends, and the nodes and hosts that they wait for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from sparseskin.launch.launchfile.spec import LaunchFile
from sparseskin.nodes.graph import Link
from sparseskin.nodes.host import is_latched

from .process import NodeProcess, awake_s

SLOW_S = 5.0
"""Time of a start after which the late nodes are logged, seconds."""
READER_S = 1.0
"""Time that a player waits for its readers before that is logged, seconds."""
HOST_S = 3.0
"""Time that other hosts are waited for before that is logged, seconds."""
AGAIN_S = 30.0
"""Time after which the same missing nodes are logged again, seconds."""


def late_at_start(node: NodeProcess) -> str:
    """The line for a node that is not ready, with what it waits for; "" for one that is."""
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
    """The line for a player that waits for readers, with the remedy; "" for any other node."""
    settings = node.spec.settings
    waits = hasattr(settings, "lockstep")  # a player
    if not waits or node.ended or node.state.get("paused", True):
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
    lines = []
    for name in late:
        writers = sorted({ln.writer for ln in links if ln.reader == name and ln.writer in late})
        why = f"waits for {', '.join(writers)}" if writers else "has not ended its stream"
        lines.append(f"{name} ({why})")
    return lines


def all_read(nodes: Iterable[NodeProcess]) -> Callable[[], bool]:
    """A check that is True once the nodes have read all that was sent to them: each has ended, or
    its counts are the same over two heartbeats.
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


def or_log(
    done: Callable[[], bool],
    nodes: Iterable[NodeProcess],
    log: Callable[[str], None],
    now_s: Callable[[], float] = awake_s,
    late: Callable[[NodeProcess], str] = slow_at_start,
    slow_s: float = SLOW_S,
) -> Callable[[], bool]:
    """A check like `done` that logs the late nodes once, where it takes longer than `slow_s`."""
    due_s = now_s() + slow_s
    logged = False

    def check() -> bool:
        nonlocal logged
        if done():
            return True
        if not logged and now_s() >= due_s:
            for line in filter(None, map(late, nodes)):
                logged = True
                log(f"[launch] {line}")
        return False

    return check


class Missing:
    """Logs the nodes of other hosts for which those of a part of a graph wait; `now_s` is the time
    on any monotonic clock, seconds.
    """

    def __init__(self, launch: LaunchFile, log: Callable[[str], None], now_s: float) -> None:
        self._launch = launch
        self._log = log
        self._logged: tuple[str, ...] = ()
        self._next_s = now_s + HOST_S

    def report(self, nodes: Iterable[NodeProcess], now_s: float) -> None:
        """Log the missing nodes: after `HOST_S`, when they change, and every `AGAIN_S`."""
        lines = tuple(self._lines(nodes))
        due = now_s >= self._next_s
        if lines and due and (lines != self._logged or now_s >= self._next_s + AGAIN_S):
            for line in lines:
                self._log(f"[launch] {line}")
            self._logged = lines
            self._next_s = now_s
        elif not lines:
            self._logged = ()

    def _lines(self, nodes: Iterable[NodeProcess]) -> Iterable[str]:
        lacking: dict[str, set[str]] = {}
        for node in nodes:
            for reader in node.lacks:
                if reader in self._launch.elsewhere:
                    host = self._launch.elsewhere[reader].host
                    lacking.setdefault(host, set()).add(reader)
        for host, names in sorted(lacking.items()):
            yield f"waits for {', '.join(sorted(names))} on {host}"
