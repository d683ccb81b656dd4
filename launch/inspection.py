"""What a running graph tells of itself to whoever asks, by way of its control socket."""

from __future__ import annotations

import argparse
import select
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sparseskin.nodes.host import COUNTED
from sparseskin.nodes.lookup import did_you_mean

from .control_socket import ControlClient
from .running import GraphError, RunningGraph

PATIENCE_S = 8.0
"""The launcher answers after 5 s in place of a node that does not."""

ELSEWHERE = "(another host)"
"""Stands for a publisher whose name is not known here."""


@dataclass(frozen=True)
class Answer:
    """What became of a request: whether it was done, and what was said."""

    done: bool
    text: str


@dataclass(frozen=True)
class Topic:
    """A topic of a running graph, as its description tells of it.

    Attributes
    ----------
    name : str
        "/PATCH/SCHEMA".
    publisher : str
        Name of the node that writes it; "" where it is on another host.
    sent : int
        Messages that the node has sent on it.
    readers : dict of str to dict
        "received", "lost" and "skipped" of each node that reads it.
    """

    name: str
    publisher: str
    sent: int
    readers: dict[str, dict[str, int]]


def add_graph_option(parser: argparse.ArgumentParser) -> None:
    """Add --graph, as all commands beside a running graph have it."""
    parser.add_argument(
        "--graph", metavar="NAME|PID", help="which graph, where several run on this host"
    )


def describe(graph: RunningGraph, node: str | None = None) -> dict[str, Any]:
    """The description of a graph: `sparseskin.launch.graph_state.graph_description`.

    Raises
    ------
    GraphError
        If the graph does not answer.
    """
    described = _exchange(graph, {"describe": node}, "description")
    assert isinstance(described, dict)
    return described


def describe_node(graph: RunningGraph, name: str) -> dict[str, Any]:
    """One node of a graph, with its settings.

    Raises
    ------
    GraphError
        If the graph has no such node (with a did-you-mean), or does not answer.
    """
    nodes = {node["name"]: node for node in describe(graph, name)["nodes"]}
    if name not in nodes:
        raise GraphError(f"{name}: {graph.label} has no such node{did_you_mean(name, nodes)}")
    found: dict[str, Any] = nodes[name]
    return found


def topics_of(described: Mapping[str, Any]) -> dict[str, Topic]:
    """The topics of a described graph, by name, in the order of their publishers."""
    topics = {
        out["topic"]: Topic(out["topic"], node["name"], out["sent"], {})
        for node in described["nodes"]
        for out in node["outputs"]
    }
    for node in described["nodes"]:
        for entry in node["inputs"]:
            topic = topics.setdefault(entry["topic"], Topic(entry["topic"], "", 0, {}))
            topic.readers[node["name"]] = {key: entry[key] for key in COUNTED}
    return topics


def find_topic(graph: RunningGraph, name: str) -> str:
    """The topic of that name; its first slash may be left out.

    Raises
    ------
    GraphError
        If the graph has no such topic (with a did-you-mean), or publishes it on another host.
    """
    writers = graph.writers()
    for topic in (name, f"/{name}"):
        if topic in writers:
            return topic
    read = topics_of(describe(graph))
    if name in read or f"/{name}" in read:
        raise GraphError(f"{name}: is published on another host; look at it there")
    raise GraphError(f"{name}: {graph.label} has no such topic{did_you_mean(name, writers)}")


def ask_node(graph: RunningGraph, node: str, command: str, value: Any) -> Answer:
    """Have a node do something, and wait for its answer.

    Raises
    ------
    GraphError
        If the graph does not answer.
    """
    request = {"id": "1", "node": node, "command": command, "value": value}
    answer = _exchange(graph, request, "answer")
    return Answer(answer["done"], answer["text"])


def _exchange(graph: RunningGraph, request: Mapping[str, Any], key: str) -> Any:
    """Send one request, and wait for the object that answers it."""
    client = ControlClient(graph.control)
    try:
        client.send(request)
        deadline = time.monotonic() + PATIENCE_S
        while (left_s := deadline - time.monotonic()) > 0:
            select.select([client.fd], [], [], left_s)
            news = client.receive()
            if news is None:
                raise GraphError(f"{graph.label}: has ended, or is asked by too many at once")
            for fields in news:
                if key in fields:
                    return fields[key]
                raise GraphError(f"{graph.label}: runs a version that cannot be asked this")
    finally:
        client.close()
    raise GraphError(f"{graph.label}: has not answered within {PATIENCE_S:g} s")
