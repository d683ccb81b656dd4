"""Says whom a part of a graph waits for on other hosts, and whom it does not hear."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from .launchspec import LaunchFile
from .process import NodeProcess

PATIENCE_S = 3.0
"""How long hosts are waited for before a line says so."""
AGAIN_S = 30.0


class Missing:
    """Watches what the nodes of one host lack of the others.

    Parameters
    ----------
    launch : LaunchFile
        The part.
    log : callable
        Takes one line of text.
    now_s : float
        Now, on any clock of the host that never goes back.
    """

    def __init__(self, launch: LaunchFile, log: Callable[[str], None], now_s: float) -> None:
        self._launch = launch
        self._log = log
        self._said: tuple[str, ...] = ()
        self._next_s = now_s + PATIENCE_S

    def tell(self, nodes: Iterable[NodeProcess], now_s: float) -> None:
        """Name who is missing: after a while, when it changes, and now and then again."""
        lines = tuple(self._lines(nodes))
        due = now_s >= self._next_s
        if lines and due and (lines != self._said or now_s >= self._next_s + AGAIN_S):
            for line in lines:
                self._log(f"[launch] {line}")
            self._said = lines
            self._next_s = now_s
        elif not lines:
            self._said = ()

    def _lines(self, nodes: Iterable[NodeProcess]) -> Iterable[str]:
        lacking: dict[str, set[str]] = {}
        for node in nodes:
            for reader in node.lacks:
                if reader in self._launch.elsewhere:
                    host = self._launch.elsewhere[reader].host
                    lacking.setdefault(host, set()).add(reader)
        for host, names in sorted(lacking.items()):
            yield f"waits for {', '.join(sorted(names))} on {host}"


def hosts_state(launch: LaunchFile, nodes: Iterable[NodeProcess]) -> dict[str, dict[str, Any]]:
    """What is known here of each other host.

    Returns
    -------
    dict of str to dict
        heard (bool, None where no node here listens to one there), silent (names of the nodes
        that should be heard and are not), clock_offset_ms and clock_uncertainty_ms (None while
        they are not known; the clock there is ahead by the offset, within the uncertainty).
    """
    found: dict[str, dict[str, Any]] = {
        name: {
            "heard": None,
            "silent": [],
            "clock_offset_ms": None,
            "clock_uncertainty_ms": None,
        }
        for name in launch.hosts
        if name != launch.host
    }
    if not launch.host:
        return {}
    for node in nodes:
        for writer, heard in node.heard.items():
            state = found[launch.elsewhere[writer].host]
            if not heard and writer not in state["silent"]:
                state["silent"].append(writer)
            state["heard"] = not state["silent"]
        for host, (offset_ns, uncertainty_ns) in node.clocks.items():
            known = found[host]["clock_uncertainty_ms"]
            if known is None or uncertainty_ns / 1e6 < known:
                found[host]["clock_offset_ms"] = offset_ns / 1e6
                found[host]["clock_uncertainty_ms"] = uncertainty_ns / 1e6
    return found
