"""A graph as text for a terminal, and as DOT text, of which Graphviz draws a picture."""

from __future__ import annotations

import json

from sparseskin.launch.attach.text import table
from sparseskin.messages.text import printable
from sparseskin.messages.topics import split_topic

from .spec import LaunchFile, NodeSpec

_TELLING = {"sensor": "source", "reconstructor": "preset", "player": "file", "recorder": "out"}
"""Of a type of node the setting whose value stands in its box."""
_MAX_VALUE = 40


def graph_text(launch: LaunchFile) -> str:
    """Nodes with their settings, then hosts, then topics with those that write and read them."""
    nodes = []
    for node in launch.nodes.values():
        stated = {
            "host": node.host,
            **{key: value for key, value in node.values.items() if key != "launch"},
            "cpus": list(node.scheduling.cpus),
            "priority": node.scheduling.priority,
        }
        shown = [  # of the keys of all nodes those that are stated
            f"{key} = {value!r}" for key, value in stated.items() if value or key in node.values
        ]
        nodes.append([node.name, node.type_name, ", ".join(shown)])
    hosts = [
        [name, host.address, ", ".join(f"{n.name} at {n.public}" for n in here if n.public)]
        for name, host in launch.hosts.items()
        for here in ([n for n in launch.nodes.values() if n.host == name],)
    ]
    topics = [
        [topic, links[0].writer, ", ".join(link.reader for link in links)]
        for topic in dict.fromkeys(link.topic for link in launch.links)
        for links in ([link for link in launch.links if link.topic == topic],)
    ]
    lines = [f"{launch.name}: {launch.description}", f"transport {launch.transport}", ""]
    lines += table(["NODE", "TYPE", "SETTINGS"], nodes)
    lines += ["", *table(["HOST", "ADDRESS", "NODES"], hosts)] if hosts else []
    lines += ["", *table(["TOPIC (/PATCH/SCHEMA)", "PUBLISHER", "SUBSCRIBERS"], topics)]
    return "\n".join(map(printable, lines))


def dot_of(launch: LaunchFile) -> str:
    """The nodes of all hosts and their links as DOT, the language of Graphviz; a box a host."""
    nodes = {**launch.nodes, **launch.elsewhere}
    title = f"{launch.name}: {launch.description}".rstrip(": ")
    lines = [
        "digraph {",
        "rankdir=LR; labelloc=t; ranksep=1; fontname=Helvetica; fontsize=11",
        f"label={_quoted(title)}",
        'node [shape=box, style="rounded,filled", fillcolor="#dbe9f6", fontname=Helvetica, '
        "fontsize=11]",
        'edge [color="#4a6f95", fontcolor="#4a6f95", fontname=Helvetica, fontsize=10]',
    ]
    for host in dict.fromkeys(spec.host for spec in nodes.values()):
        boxes = [_box(spec) for spec in nodes.values() if spec.host == host]
        if host:
            name = _quoted(f"cluster_{host}")
            boxes = [f"subgraph {name} {{", f"label={_quoted(host)}", *boxes, "}"]
        lines += boxes
    topics: dict[tuple[str, str], list[str]] = {}
    for link in launch.links:
        topics.setdefault((link.writer, link.reader), []).append(link.topic)
    for (writer, reader), names in topics.items():
        ends = f"{_quoted(writer)} -> {_quoted(reader)}"
        lines.append(f"{ends} [label={_quoted(_label(names))}]")
    return "\n".join([*lines, "}"]) + "\n"


def _box(spec: NodeSpec) -> str:
    """A node: its name, its type where that differs, and the setting that sets it apart."""
    about = str(spec.values.get(_TELLING.get(spec.type_name, ""), ""))[:_MAX_VALUE]
    kind = "" if spec.type_name == spec.name else spec.type_name
    text = "\n".join(filter(None, (spec.name, kind, about)))
    return f"{_quoted(spec.name)} [label={_quoted(text)}]"


def _label(topics: list[str]) -> str:
    """Topics, a line each patch: "/skin/ taxels, truth"."""
    schemas: dict[str, list[str]] = {}
    for topic in topics:
        patch, schema = split_topic(topic)
        schemas.setdefault(patch, []).append(schema)
    return "\n".join(f"/{patch}/ {', '.join(names)}" for patch, names in schemas.items())


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
