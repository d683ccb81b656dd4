"""Questions to a running graph, by its control socket: its nodes, topics and settings."""

import select
import time
from collections.abc import Mapping
from contextlib import closing
from typing import Any

from sparseskin.launch.run.running import GraphError, RunningGraph
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.process.control import COUNTED, ControlClient, Document

from .text import flowing

PATIENCE_S = 30.0
"""Longest time that a launcher may take to answer, seconds; after 20 s it answers in place of a
node that does not."""

ELSEWHERE = "(another host)"
"""Shown for a publisher whose name is not known here."""


def describe(graph: RunningGraph, node: str | None = None) -> Document:
    """The description of a graph: `sparseskin.launch.run.state.graph_description`.
    Raises GraphError if the graph does not answer.
    """
    with closing(ControlClient(graph.control)) as client:
        request = {"describe": node}
        described: Document = _exchange(graph, client, request, "description")
        return described


def describe_node(graph: RunningGraph, name: str) -> Document:
    """One node of a graph, with its settings.
    Raises GraphError if the graph has no such node (with a did-you-mean), or does not answer.
    """
    # Settings come with the description of the node that is asked for.
    described = describe(graph, name)
    nodes = {node["name"]: node for node in described["nodes"]}
    if name not in nodes:
        raise GraphError(
            f"{name}: {graph.label} has no such node{did_you_mean(name, nodes)}"
        )
    node: Document = nodes[name]
    return node


def topics_of(described: Mapping[str, Any]) -> dict[str, Document]:
    """The topics of a described graph by name: topic, schema, latched, publisher ("" where that is
    on another host), sent (number of messages), subscribers (node and its `COUNTED` messages).
    """
    topics: dict[str, Document] = {}
    for node in described["nodes"]:
        for entry in node["outputs"]:
            topic = topics.setdefault(entry["topic"], _unread_topic(entry))
            topic["publisher"] = node["name"]
            topic["sent"] = entry["sent"]
    # Then who reads them; a topic that is published on another host has no output here.
    for node in described["nodes"]:
        for entry in node["inputs"]:
            topic = topics.setdefault(entry["topic"], _unread_topic(entry))
            counts = {count: entry[count] for count in COUNTED}
            topic["subscribers"].append({"node": node["name"], **counts})
    return topics


def _unread_topic(entry: Mapping[str, Any]) -> Document:
    """A topic without its publisher and subscribers."""
    name = entry["topic"]
    return {
        "topic": name,
        "schema": name.rpartition("/")[2],
        "latched": entry["latched"],
        "publisher": "",
        "sent": 0,
        "subscribers": [],
    }


def find_topic(graph: RunningGraph, name: str) -> str:
    """The topic of that name; its first slash may be left out.
    Raises GraphError if the graph has no such topic (with a did-you-mean), or publishes it on
    another host.
    """
    writers = graph.writers()
    # People leave out the first slash.
    for topic in (name, f"/{name}"):
        if topic in writers:
            return topic

    # A topic that is only read here has its publisher on another host.
    read = topics_of(describe(graph))
    if name in read or f"/{name}" in read:
        raise GraphError(f"{name}: is published on another host; look at it there")
    hint = did_you_mean(name, writers)
    if name.endswith("/contacts"):
        hint = "; start it with reconstructor.contacts=true"
    raise GraphError(f"{name}: {graph.label} has no such topic{hint}")


def ask_node(graph: RunningGraph, node: str, command: str, value: Any) -> str:
    """Send a command to a node, and return its answer.
    Raises GraphError if the node refuses, or the graph does not answer.
    """
    request = {
        "id": "1",
        "node": node,
        "command": command,
        "value": value,
    }
    with closing(ControlClient(graph.control)) as client:
        # A node answers between two frames, which may take it a while.
        answer = _exchange(graph, client, request, "answer")
    # A node may answer in several lines; a refusal is one.
    text = flowing(answer["text"])
    if not answer["done"]:
        raise GraphError(f"{node}: {text.removeprefix(f'{node}: ')}")
    return text


def stop(graph: RunningGraph) -> None:
    """End a graph as an interrupt does, and wait for its end.
    Raises GraphError if the graph does not answer.
    """
    with closing(ControlClient(graph.control)) as client:
        _exchange(graph, client, {"stop": True}, "stopping")
        # The launcher closes the connection when it ends.
        while client.receive() is not None:
            select.select([client.connection], [], [])


def _exchange(
    graph: RunningGraph, client: ControlClient, request: Mapping[str, Any], key: str
) -> Any:
    """Send one request, and wait for the object that answers it."""
    client.send(request)
    deadline_s = time.monotonic() + PATIENCE_S
    wait_s = PATIENCE_S
    while wait_s > 0:
        # Woken by an answer, or by the end of the graph.
        select.select([client.connection], [], [], wait_s)
        news = client.receive()
        if news is None:
            raise GraphError(
                f"{graph.label}: has ended, or is asked by too many at once"
            )
        if news:
            return news[0][key]
        wait_s = deadline_s - time.monotonic()
    raise GraphError(f"{graph.label}: has not answered within {PATIENCE_S:g} s")
