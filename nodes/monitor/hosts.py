"""The other hosts of a graph, in words: which of them are heard, and how well their clocks are
known.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

HEARD, SILENT, UNREAD = "heard", "silent", "unread"


def hosts_told(graph: Mapping[str, Any]) -> list[tuple[str, str]]:
    """A condition, "heard", "silent" or "unread", and a text for each other host.

    Parameters
    ----------
    graph : mapping
        The state of a graph as the launcher tells it; on one host it has no "hosts".
    """
    return [_told(name, host) for name, host in graph.get("hosts", {}).items()]


def _told(name: str, host: Mapping[str, Any]) -> tuple[str, str]:
    if host["silent"]:
        return SILENT, f"host {name}: does not hear {', '.join(host['silent'])}"
    if not host["heard"]:
        return UNREAD, f"host {name}: nothing is read from it"
    if host["clock_uncertainty_ms"] is None:
        return HEARD, f"host {name}: heard"
    return HEARD, (
        f"host {name}: heard, clock {host['clock_offset_ms']:+.2f} "
        f"± {host['clock_uncertainty_ms']:.2f} ms"
    )
