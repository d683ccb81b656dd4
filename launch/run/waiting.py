"""Nodes that are late as a graph starts or ends, and the nodes and hosts that they wait for."""

from collections.abc import Callable, Iterable, Sequence

from sparseskin.launch.launchfile.spec import LaunchFile
from sparseskin.nodes.graph import Link
from sparseskin.nodes.node_host import is_latched

from .process import NodeProcess

AFTER_S = 5.0
"""Time for which nodes are late before that is logged, seconds."""
AGAIN_S = 30.0
"""Time after which the same late nodes are logged again, seconds."""


def waits_for(node: NodeProcess, launch: LaunchFile) -> str:
    """The line for a node that is late, with what it waits for: one that is not ready, or a player
    without readers; "" for any other.
    """
    if node.ended or node.failed:
        return ""
    if node.ready:
        return _waits_for_readers(node, launch)
    if not node.endpoint:
        return f"{node.name} has not started: it imports, compiles, or opens its device"
    if not node.lacks:
        return f"{node.name} has not answered yet"
    hosts: dict[str, list[str]] = {}
    for reader in node.lacks:
        place = ""
        if reader in launch.elsewhere:
            place = f" on {launch.elsewhere[reader].host}"
        hosts.setdefault(place, []).append(reader)
    of_hosts = [", ".join(names) + place for place, names in hosts.items()]
    readers = ", ".join(of_hosts)
    return f"{node.name} waits for a subscription from {readers}"


def _waits_for_readers(node: NodeProcess, launch: LaunchFile) -> str:
    """The line for a player that waits for readers of another graph; "" for any other node."""
    settings = node.spec.settings
    # Only a player has this setting.
    if not hasattr(settings, "lockstep"):
        return ""
    n_readers = settings.wait or int(settings.lockstep)
    published = node.counts.get("published", {})

    # Latched topics are sent before it waits.
    begun = any(n for topic, n in published.items() if not is_latched(topic))
    if not n_readers or begun or node.state.get("paused", True):
        return ""
    readers = f"{n_readers} readers"
    if n_readers == 1:
        readers = "a reader"
    return (
        f"{node.name} waits for {readers}; from another terminal: "
        f"sparseskin monitor --graph {launch.name}, or sparseskin record --graph {launch.name}"
    )


def late_at_end(nodes: Iterable[NodeProcess], links: Sequence[Link]) -> list[str]:
    """The nodes that have not ended, each with those that it waits for: an end comes along the
    links, from the sources on.
    """
    # One without a late writer is the cause: it holds up the others.
    late = [node.name for node in nodes if not node.ended]
    lines = []
    for name in late:
        writers = {link.writer for link in links if link.reader == name}
        late_writers = sorted(writers.intersection(late))
        why = "has not ended its stream"
        if late_writers:
            why = f"waits for {', '.join(late_writers)}"
        lines.append(f"{name} ({why})")
    return lines


class LateLog:
    """Logs what is late, as `lines` returns it, once that has been the same for `AFTER_S`, and
    again each `AGAIN_S`. `now_s` is any monotonic clock.
    """

    def __init__(
        self,
        lines: Callable[[], list[str]],
        log: Callable[[str], None],
        now_s: Callable[[], float],
    ) -> None:
        self._lines = lines
        self._log = log
        self._now_s = now_s
        self._last: list[str] = []
        self._due_s = 0.0

    def look(self) -> None:
        """Log the lines where they are due."""
        lines = self._lines()
        now_s = self._now_s()
        if lines != self._last:
            self._last = lines
            self._due_s = now_s + AFTER_S
        elif lines and now_s >= self._due_s:
            self._due_s = now_s + AGAIN_S
            for line in lines:
                self._log(f"[launch] {line}")
