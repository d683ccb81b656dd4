"""A running graph as plain data, for observers and for its controls."""

import os
import socket
from collections.abc import Callable, Iterable

from sparseskin.launch.launchfile.spec import LIVE_RECORDER, LaunchFile
from sparseskin.nodes.node_host import is_latched
from sparseskin.nodes.process.control import COUNTED, Document

from .fleet import Fleet
from .process import NodeProcess


def graph_state(launch: LaunchFile, fleet: Fleet, recording: str | None) -> Document:
    """The state of a graph, as it is published to all that watch it; `recording` is the file that
    is recorded on request, if any.
    """
    return {
        "name": launch.name,
        "recording": recording,
        "nodes": _nodes(fleet, _in_short),
        "hosts": hosts_state(launch, fleet),
    }


def graph_description(
    launch: LaunchFile, fleet: Fleet, recording: str | None, node: str | None
) -> Document:
    """The description of a graph, for a program that asks once: with the settings of `node`, each
    with its type, range and meaning.
    """
    return {
        "name": launch.name,
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "recording": recording,
        "nodes": _nodes(fleet, lambda each: _in_full(each, each.name == node)),
    }


def _nodes(fleet: Fleet, further: Callable[[NodeProcess], Document]) -> list[Document]:
    """Each node, without live recorders that have ended, and the fields that `further` returns."""
    nodes = []
    for node in fleet:
        # One may be started for each recording: the list would grow without end.
        if node.ended and node.name.startswith(LIVE_RECORDER):
            continue
        fields = {
            "name": node.name,
            "type": node.spec.type_name,
            "condition": fleet.condition(node),
            "restarts": fleet.restarts[node.name].total,
            "line": node.line,
            "refusal": node.refusal,
            "state": node.state,
            "commands": dict(node.spec.cls.commands),
        }
        nodes.append(fields | further(node))
    return nodes


def _in_short(node: NodeProcess) -> Document:
    cls = node.spec.cls
    settings = node.spec.settings
    counts = node.counts
    log_line = ""
    if not cls.watches:
        # The page itself shows what a monitor would say.
        log_line = node.said
    return {
        "patch": getattr(settings, "patch", None),
        "patches": list(getattr(settings, "patches", ())),
        "refused": sum(counts.get("refused", {}).values()),
        "said": log_line,
        "compiled": node.compiled,
        "lost": sum(counts.get("lost", {}).values()),
        "settings": node.settings,
        "controls": [entry for entry in cls.Settings.described() if entry["live"]],
    }


def _in_full(node: NodeProcess, with_settings: bool) -> Document:
    counts = node.counts

    def counted(topic: str, counter_of: dict[str, str]) -> Document:
        fields: Document = {"topic": topic, "latched": is_latched(topic)}
        for name, counter in counter_of.items():
            fields[name] = counts.get(counter, {}).get(topic, 0)
        return fields

    of_input = {counter: counter for counter in COUNTED}
    of_output = {"sent": "published"}
    transport, _, _ = node.endpoint.partition(":")
    described: Document = {
        "pid": node.pid,
        "companions": node.config["companions"],
        "transport": transport,
        "refused": counts.get("refused", {}),
        "inputs": [counted(topic, of_input) for topic in node.config["inputs"]],
        "outputs": [counted(topic, of_output) for topic in node.outputs],
    }
    if with_settings:
        described["settings"] = _settings(node)
    return described


def _settings(node: NodeProcess) -> list[Document]:
    """Settings of a node as they are described, with their values, stated and in force."""
    values = vars(node.spec.settings) | node.settings
    # Settings that were changed while it runs are those of the node, not of the file.
    settings = []
    for entry in node.spec.cls.Settings.described():
        key = entry["key"]
        in_force = values[key]
        # A node publishes as state what it takes for a setting that is not stated.
        if in_force is None:
            in_force = node.state.get(key)
        settings.append(
            {
                **entry,
                "value": values[key],
                "in_force": in_force,
            }
        )
    return settings


def hosts_state(
    launch: LaunchFile, nodes: Iterable[NodeProcess]
) -> dict[str, Document]:
    """State of the other hosts of a graph by name, as far as the nodes of this one know: heard
    (None where no node here reads from one there), silent (names of the nodes that should send and
    do not), clock_offset_ms and clock_uncertainty_ms (None while unknown; the clock there is ahead
    by the offset, within the uncertainty).
    """
    states: dict[str, Document] = {}
    if not launch.host:
        return states
    for name in launch.hosts:
        if name != launch.host:
            # Nothing is known until a node has read from there.
            states[name] = {
                "heard": None,
                "silent": [],
                "clock_offset_ms": None,
                "clock_uncertainty_ms": None,
            }

    for node in nodes:
        for writer, heard in node.heard.items():
            state = states[launch.elsewhere[writer].host]
            if not heard and writer not in state["silent"]:
                state["silent"].append(writer)
            state["heard"] = not state["silent"]
        # Of several nodes that read from a host, the most certain one counts.
        for host, (offset_ns, uncertainty_ns) in node.clocks.items():
            state = states[host]
            uncertainty_ms = uncertainty_ns / 1e6
            least_ms = state["clock_uncertainty_ms"]
            if least_ms is None or uncertainty_ms < least_ms:
                state["clock_offset_ms"] = offset_ns / 1e6
                state["clock_uncertainty_ms"] = uncertainty_ms
    return states
