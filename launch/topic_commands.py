"""The commands `sparseskin topic ...`: the topics of a running graph."""

from __future__ import annotations

import argparse
import json
from typing import Any

from sparseskin.messages import Message
from sparseskin.messages.base import wire_fields
from sparseskin.messages.fields import Array, FieldKind, Flag, Integer, Real, Samples, Text
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.host import COUNTED

from .inspection import ELSEWHERE, Topic, add_graph_option, describe, find_topic, topics_of
from .running import choose_graph
from .text_table import printable, table, wrapped
from .topic_echo import add_echo_parser
from .topic_rates import add_rate_parsers


def add_topic_parser(commands: Any) -> None:
    """Add `topic` and its commands to the commands."""
    topic = commands.add_parser(
        "topic",
        help="list the topics of a running graph, print and measure what travels on one",
        description="The topics of a graph that runs on this host. To look at them slows "
        "nobody down: what is not taken in time is dropped for the onlooker alone, and counted.",
    )
    kinds = topic.add_subparsers(required=True, metavar="COMMAND")
    listing = kinds.add_parser(
        "list",
        help="list the topics",
        description="List the topics of a running graph, named by patch and schema, each with its "
        "publisher and subscribers. A latched topic is state: who subscribes late is sent the last "
        "message.",
    )
    listing.set_defaults(run=_list)
    info = kinds.add_parser(
        "info",
        help="tell all of one topic",
        description="Tell all of one topic: its publisher, how many messages each subscriber "
        "received and lost (as of half a second ago at most), the fields of its schema.",
    )
    info.add_argument("topic", metavar="TOPIC", help="the topic, /PATCH/SCHEMA")
    info.set_defaults(run=_info)
    for parser in (listing, info):
        parser.add_argument("--json", action="store_true", help="print one JSON document")
        add_graph_option(parser)
    add_echo_parser(kinds)
    add_rate_parsers(kinds)


def _list(arguments: argparse.Namespace) -> int:
    graph = choose_graph(arguments.graph)
    topics = [_plain(topic) for topic in topics_of(describe(graph)).values()]
    if arguments.json:
        print(json.dumps({"graph": graph.label, "topics": topics}, indent=2))
        return 0
    rows = [
        [
            topic["topic"],
            "latched" if topic["latched"] else "",
            topic["publisher"] or ELSEWHERE,
            ", ".join(reader["node"] for reader in topic["subscribers"]),
        ]
        for topic in topics
    ]
    head = ["TOPIC (/PATCH/SCHEMA)", "", "PUBLISHER", "SUBSCRIBERS"]
    print("\n".join(table(head, rows)))
    return 0


def _plain(topic: Topic) -> dict[str, Any]:
    schema = split_topic(topic.name)[1]
    return {
        "topic": topic.name,
        "schema": schema,
        "latched": SCHEMAS[schema].latched,
        "publisher": topic.publisher,
        "sent": topic.sent,
        "subscribers": [{"node": name, **counts} for name, counts in topic.readers.items()],
    }


def _info(arguments: argparse.Namespace) -> int:
    graph = choose_graph(arguments.graph)
    name = find_topic(graph, arguments.topic)
    topic = _plain(topics_of(describe(graph))[name])
    cls = SCHEMAS[topic["schema"]]
    fields = {field: kind_text(kind) for field, kind in wire_fields(cls).items()}
    if arguments.json:
        told = {"graph": graph.label, **topic, "version": cls.version, "about": about(cls)}
        print(json.dumps({**told, "fields": fields}, indent=2))
        return 0
    lines = [
        name,
        *wrapped("  schema     ", f"{cls.schema}, version {cls.version}"),
        *wrapped("  about      ", about(cls)),
        *wrapped("  kind       ", "state: latched" if topic["latched"] else "a stream"),
        *wrapped("  publisher  ", f"{topic['publisher']}, {topic['sent']} sent"),
        "",
    ]
    readers = [[one["node"], *(one[what] for what in COUNTED)] for one in topic["subscribers"]]
    lines += table(["SUBSCRIBER", *(what.upper() for what in COUNTED)], readers, "  ")
    lines += ["", *table(["FIELD", "TYPE"], list(fields.items()), "  ")]
    print("\n".join(lines))
    return 0


def about(cls: type[Message]) -> str:
    """The first sentences of what a message class says of itself."""
    return printable((cls.__doc__ or "").partition("\n\n")[0])


def kind_text(kind: FieldKind) -> str:
    """What a field may hold, in a few words."""
    match kind:
        case Integer():
            return "whole number"
        case Real():
            return "number" + (" or none" if kind.optional else "")
        case Flag():
            return "true or false"
        case Text():
            return f"text of at most {kind.longest} characters"
        case Samples():
            return "array of float32, 1 dimension; or of whole numbers of few bits and a step"
        case Array():
            sides = "1 dimension" if kind.ndim == 1 else f"{kind.ndim} dimensions"
            names = {"<f4": "float32", "<f8": "float64", "|b1": "booleans", "<i4": "int32"}
            return f"array of {names.get(kind.dtype, kind.dtype)}, {sides}" + (
                " or none" if kind.optional else ""
            )
    return type(kind).__name__.lower()
