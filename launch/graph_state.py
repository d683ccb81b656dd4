"""A running graph as plain data, for whoever watches it or sits at its controls."""

from __future__ import annotations

from typing import Any

from .fleet import Fleet
from .live_recording import LIVE_RECORDER
from .process import NodeProcess


def graph_state(name: str, fleet: Fleet, recording: str | None) -> dict[str, Any]:
    """The state of a graph.

    Parameters
    ----------
    name : str
        Name of the graph.
    fleet : Fleet
        Its nodes.
    recording : str or None
        File that is being recorded on request, if any.
    """
    return {
        "name": name,
        "recording": recording,
        "nodes": [
            _node_state(fleet, node)
            for node in fleet
            if not (node.ended and node.name.startswith(LIVE_RECORDER))
        ],
    }


def _node_state(fleet: Fleet, node: NodeProcess) -> dict[str, Any]:
    cls, settings = node.spec.cls, node.spec.settings
    counts = node.counts
    return {
        "name": node.name,
        "type": node.spec.type_name,
        "patch": getattr(settings, "patch", None),
        "condition": fleet.condition(node),
        "restarts": fleet.n_restarts(node.name),
        "line": node.line,
        "refused": sum(counts.get("refused", {}).values()),
        "refusal": node.refusal,
        "said": node.said if not cls.watches else "",
        "lost": sum(counts.get("lost", {}).values()),
        "state": node.state,
        "settings": node.settings,
        "controls": [entry for entry in cls.Settings.described() if entry["live"]],
        "commands": dict(cls.commands),
    }
