"""Nodes that are late as a graph starts or ends, and the nodes and hosts that they wait for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from sparseskin.launch.launchfile.spec import LaunchFile
from sparseskin.nodes.graph import Link
from sparseskin.nodes.node_host import is_latched

from .process import NodeProcess, awake_s

SLOW_S = 5.0
"""Time of a start after which the late nodes are logged, seconds."""
READER_S = 1.0
"""Time that a player waits for its readers before that is logged, seconds."""
HOST_S = 3.0
"""Time that other hosts are waited for before that is logged, seconds."""
AGAIN_S = 30.0
"""Time after which the same missing nodes are logged again, seconds."""


def late_at_start(node: NodeProcess, after_s: float) -> str:
    """The line for a node that is not ready `after_s` after the start, with what it waits for; ""
    for one that is.
    """
    if node.ready:
        return ""
    if not node.endpoint:
        return f"{node.name} has not started: it imports, or opens its device ({after_s:g} s)"
    if node.lacks:
        readers = ", ".join(node.lacks)
        return f"{node.name} waits for a subscription from {readers} ({after_s:g} s)"
    return f"{node.name} has not answered yet ({after_s:g} s)"


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


def missing_nodes(nodes: Iterable[NodeProcess], launch: LaunchFile) -> list[str]:
    """A line for each other host with nodes for which those of this part wait."""
    lacking: dict[str, set[str]] = {}
    for node in nodes:
        for reader in node.lacks:
            if reader in launch.elsewhere:
                lacking.setdefault(launch.elsewhere[reader].host, set()).add(reader)
    return [f"waits for {', '.join(sorted(n))} on {host}" for host, n in sorted(lacking.items())]


class LateLog:
    """Logs what is late, as `lines` returns it, once it has been for `after_s`, and once more each
    time that it changes or `again_s` are over; None: never again. `now_s` is any monotonic clock.
    """

    def __init__(
        self,
        lines: Callable[[], Iterable[str]],
        log: Callable[[str], None],
        after_s: float,
        again_s: float | None = None,
        now_s: Callable[[], float] = awake_s,
    ) -> None:
        self._lines, self._log, self._again_s, self._now_s = lines, log, again_s, now_s
        self._due_s = now_s() + after_s
        self._logged: list[str] = []

    def look(self) -> None:
        """Log the lines where they are due."""
        now_s = self._now_s()
        if now_s < self._due_s or (self._logged and self._again_s is None):
            return
        lines = list(filter(None, self._lines()))
        if not lines:
            self._logged = []
        elif lines != self._logged or now_s >= self._due_s + (self._again_s or 0.0):
            for line in lines:
                self._log(f"[launch] {line}")
            self._logged, self._due_s = lines, now_s
