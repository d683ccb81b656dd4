"""The commands `sparseskin topic ...`: the topics of a running graph."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sparseskin.launch.attach.client import (
    ELSEWHERE,
    Topic,
    add_command,
    add_graph_option,
    describe,
    find_topic,
    topics_of,
)
from sparseskin.launch.attach.give_way import give_way
from sparseskin.launch.attach.text_table import flowing, table, wrapped
from sparseskin.launch.run.running import choose_graph
from sparseskin.nodes.process.control import COUNTED

if TYPE_CHECKING:
    from sparseskin.messages import Message
    from sparseskin.messages.fields import FieldKind

WINDOW = 1000
FEW_MESSAGES = 100
"""So many messages are over before reading them could disturb a graph."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `topic`."""
    parser.description = (
        "The topics of a graph that runs on this host. To observe one slows no node down: what is "
        "not read in time is dropped for the observer alone, and counted."
    )
    kinds = parser.add_subparsers(required=True, metavar="COMMAND")
    listing = add_command(
        kinds,
        "list",
        _list,
        "list the topics",
        "List the topics of a running graph, named by patch and schema, each with its publisher "
        "and subscribers. A latched topic is state: who subscribes late is sent the last message.",
    )
    info = add_command(
        kinds,
        "info",
        _info,
        "describe one topic",
        "Describe one topic: its publisher, how many messages each subscriber received and lost "
        "(as of half a second ago at most), the fields of its schema.",
    )
    echo = add_command(
        kinds,
        "echo",
        _echo,
        "print messages",
        "Print the messages of a topic, of arrays a summary. Those that are not shown are counted.",
    )
    over = "A line a second, over the last messages; at the end, or with Ctrl-C, one over all."
    rates = [
        add_command(kinds, name, _rate, about, f"{description} {over}")
        for name, (about, description) in RATES.items()
    ]
    for one in (info, echo, *rates):
        one.add_argument("topic", metavar="TOPIC", help="the topic, /PATCH/SCHEMA")
    echo.add_argument("--once", action="store_true", help="end after one message")
    for one in rates:
        one.set_defaults(measure=one.prog.split()[-1])
        one.add_argument(
            "--window",
            metavar="K",
            type=_whole(2),
            default=WINDOW,
            help=f"how many messages a line is over, at most (default: {WINDOW})",
        )
    for one in (echo, *rates):
        one.add_argument("-n", metavar="K", type=_whole(1), help="end after K messages")
        one.add_argument("--duration", metavar="S", type=_real(True), help="end after S seconds")
    echo.add_argument("--full", action="store_true", help="print all elements of arrays")
    echo.add_argument(
        "--field", metavar="FIELD", help="print one field; FIELD[I,J]: one element of an array"
    )
    echo.add_argument(
        "--max-hz",
        metavar="R",
        type=_real(False),
        help="print R messages a second at most, 0: all (default: 10; all with --json or -n)",
    )
    for one in (listing, info, echo, *rates):
        document = "one JSON document" if one in (listing, info) else "one JSON object a line"
        one.add_argument("--json", action="store_true", help=f"print {document}")
        add_graph_option(one)


RATES = {
    "hz": (
        "print the rate of messages, sent and arriving",
        "Print the rate at which messages are sent and the interval between two, by their numbers "
        "and stamps, the rate at which they arrive here, and how many were lost on the way.",
    ),
    "bw": (
        "print the bytes a second that arrive",
        "Print the bytes a second that arrive here, and the size of a message on the wire.",
    ),
    "delay": (
        "print the age of messages as they arrive",
        "Print the time from a message's stamp, the acquisition of its frame, to its arrival "
        "here, on the clock of this host. It reads as a node does, and competes with the graph for "
        "the processor as a node does.",
    ),
}
"""Of each command that measures its help and its description."""


def _whole(low: int) -> Callable[[str], int]:
    def whole(text: str) -> int:
        if not (text.isascii() and text.isdigit() and len(text) < 16) or int(text) < low:
            raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number, {low} or more")
        return int(text)

    return whole


def _real(above_0: bool) -> Callable[[str], float]:
    def real(text: str) -> float:
        with contextlib.suppress(ValueError):
            value = float(text)
            if 0 <= value < math.inf and (value or not above_0):
                return value
        allowed = "a number above 0" if above_0 else "a number, 0 or more"
        raise argparse.ArgumentTypeError(f"{text!r}: expected {allowed}")

    return real


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
    return {
        "topic": topic.name,
        "schema": topic.schema,
        "latched": topic.latched,
        "publisher": topic.publisher,
        "sent": topic.sent,
        "subscribers": [{"node": name, **counts} for name, counts in topic.readers.items()],
    }


def _info(arguments: argparse.Namespace) -> int:
    from sparseskin.messages.base import wire_fields
    from sparseskin.messages.wire import SCHEMAS

    graph = choose_graph(arguments.graph)
    name = find_topic(graph, arguments.topic)
    topic = _plain(topics_of(describe(graph))[name])
    cls = SCHEMAS[topic["schema"]]
    fields = {field: kind_text(kind) for field, kind in wire_fields(cls).items()}
    if arguments.json:
        described = {"graph": graph.label, **topic, "version": cls.version, "about": about(cls)}
        print(json.dumps({**described, "fields": fields}, indent=2))
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


def _echo(arguments: argparse.Namespace) -> int:
    from sparseskin.launch.attach.echo import FieldPath, echo
    from sparseskin.messages.wire import SCHEMAS

    graph = choose_graph(arguments.graph)
    topic = find_topic(graph, arguments.topic)
    cls = SCHEMAS[topic.rpartition("/")[2]]
    field = FieldPath(arguments.field, cls) if arguments.field is not None else None
    n = 1 if arguments.once else arguments.n
    if n is None or n > FEW_MESSAGES:
        give_way()
    return echo(
        graph,
        topic,
        n=n,
        duration_s=arguments.duration,
        max_hz=arguments.max_hz,
        field=field,
        in_json=arguments.json,
        full=arguments.full,
    )


def _rate(arguments: argparse.Namespace) -> int:
    from sparseskin.launch.attach.rates import MEASURES, measure

    graph = choose_graph(arguments.graph)
    topic = find_topic(graph, arguments.topic)
    what = MEASURES[arguments.measure]
    if what.patience_s:
        give_way()
    return measure(
        graph,
        topic,
        what,
        window=arguments.window,
        n=arguments.n,
        duration_s=arguments.duration,
        in_json=arguments.json,
    )


def about(cls: type[Message]) -> str:
    """The first paragraph of the docstring of a message class."""
    return flowing((cls.__doc__ or "").partition("\n\n")[0])


def kind_text(kind: FieldKind) -> str:
    """Type of a field, in a few words."""
    from sparseskin.messages.fields import Array, Flag, Integer, Real, Samples, Text

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
