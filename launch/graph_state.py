"""A running graph as plain data, for whoever watches it or sits at its controls."""

from __future__ import annotations

import dataclasses
import os
import socket
from collections.abc import Mapping
from typing import Any

from sparseskin.nodes.host import COUNTED

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
        "nodes": [_node_state(fleet, node) for node in _present(fleet)],
    }


def graph_description(
    name: str, fleet: Fleet, recording: str | None, node: str | None
) -> dict[str, Any]:
    """All that can be told of a graph to somebody who asks once.

    Parameters
    ----------
    name : str
        Name of the graph.
    fleet : Fleet
        Its nodes.
    recording : str or None
        File that is being recorded on request, if any.
    node : str or None
        The one node whose settings are told too, each with what it may be.
    """
    return {
        "name": name,
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "recording": recording,
        "nodes": [_node_description(fleet, one, one.name == node) for one in _present(fleet)],
    }


def _present(fleet: Fleet) -> list[NodeProcess]:
    """The nodes, without recorders that have done their work."""
    return [node for node in fleet if not (node.ended and node.name.startswith(LIVE_RECORDER))]


def _node_description(fleet: Fleet, node: NodeProcess, in_full: bool) -> dict[str, Any]:
    published = node.counts.get("published", {})
    outputs = node.spec.cls.outputs(node.spec.settings)
    told = {
        "name": node.name,
        "type": node.spec.type_name,
        "condition": fleet.condition(node),
        "pid": node.pid,
        "restarts": fleet.n_restarts(node.name),
        "line": node.line,
        "state": node.state,
        "refused": node.counts.get("refused", {}),
        "refusal": node.refusal,
        "inputs": [
            {"topic": topic} | {what: node.counts.get(what, {}).get(topic, 0) for what in COUNTED}
            for topic in node.config["inputs"]
        ],
        "outputs": [{"topic": topic, "sent": published.get(topic, 0)} for topic in outputs],
        "commands": dict(node.spec.cls.commands),
    }
    if in_full:
        settings = node.spec.settings
        values = {f.name: getattr(settings, f.name) for f in dataclasses.fields(settings)}
        values |= node.settings
        told["settings"] = [
            {**entry, "value": value, "in_force": _in_force(entry["key"], value, node.state)}
            for entry in node.spec.cls.Settings.described()
            for value in (values[entry["key"]],)
        ]
    return told


def _in_force(key: str, value: Any, state: Mapping[str, Any]) -> Any:
    """The value that a node works with: where none is stated, the one that it tells of itself."""
    return state.get(key) if value is None else value


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
