"""The commands `sparseskin topic ...`: the topics of a running graph."""

import argparse
import contextlib
import os
from typing import TYPE_CHECKING

from sparseskin.launch.attach.client import ELSEWHERE, describe, find_topic, topics_of
from sparseskin.launch.attach.text import facts, flowing, table
from sparseskin.launch.run.running import choose_graph
from sparseskin.nodes.process.control import COUNTED

from .options import add_commands, add_graph, rare, real, show, whole

if TYPE_CHECKING:
    from sparseskin.messages import Message
    from sparseskin.messages.fields import FieldKind

FEW_MESSAGES = 100
"""So many messages are over before reading them could disturb a graph."""
WORDS = {
    "Integer": "whole number",
    "Real": "number",
    "Flag": "true or false",
    "Names": "names of patches; none for one",
}
"""Types of fields that have no limit of their own."""


def configure(parser: argparse.ArgumentParser) -> None:
    add = add_commands(
        parser,
        "The topics of a graph that runs on this host. To observe one slows no node down: what is "
        "not read in time is dropped for the observer alone, and counted.",
    )
    listing = add("list", _list, "list the topics")
    info = add("info", _info, "describe one topic")
    echo = add("echo", _echo, "print messages")
    hz = add("hz", _hz, "measure their rate, bytes and age")
    for command in (info, echo, hz):
        command.add_argument("topic", metavar="TOPIC", help="the topic, /PATCH/SCHEMA")
    echo.add_argument("--once", action="store_true", help="end after one message")
    for command in (echo, hz):
        command.add_argument(
            "--duration",
            metavar="S",
            type=real(True),
            help="end after S seconds",
        )
        rare(command).add_argument(
            "-n",
            metavar="K",
            type=whole(1),
            help="end after K messages",
        )
    echo.add_argument(
        "--field",
        metavar="FIELD",
        help="print one field; FIELD[I,J]: one element of an array",
    )
    rare(echo).add_argument(
        "--full", action="store_true", help="print all elements of arrays"
    )
    about = (
        "print R messages a second at most, 0: all (default: 10; all with --json or -n)"
    )
    rare(echo).add_argument(
        "--max-hz",
        metavar="R",
        type=real(False),
        help=about,
    )
    for command in (listing, info):
        add_graph(command, "one JSON document")
    for command in (echo, hz):
        add_graph(command, "one JSON object a line")


def _list(arguments: argparse.Namespace) -> int:
    """List the topics of a running graph, named by patch and schema, each with its publisher and
    subscribers. A latched topic is state: who subscribes late is sent the last message.
    """
    graph = choose_graph(arguments.graph)
    # In the order of the nodes that publish them.
    topics = list(topics_of(describe(graph)).values())
    rows = []
    for topic in topics:
        kind = ""
        if topic["latched"]:
            kind = "latched"
        readers = ", ".join(reader["node"] for reader in topic["subscribers"])
        rows.append([topic["topic"], kind, topic["publisher"] or ELSEWHERE, readers])
    head = ["TOPIC (/PATCH/SCHEMA)", "", "PUBLISHER", "SUBSCRIBERS"]
    document = {"graph": graph.label, "topics": topics}
    return show(arguments, "topic-list", document, table(head, rows))


def _info(arguments: argparse.Namespace) -> int:
    """Describe one topic: its publisher and where that sends, how many messages each subscriber
    received and lost (as of half a second ago at most), the fields of its schema.
    """
    from sparseskin.messages.base import wire_fields
    from sparseskin.messages.wire import SCHEMAS

    graph = choose_graph(arguments.graph)
    name = find_topic(graph, arguments.topic)
    topic = topics_of(describe(graph))[name]
    # The schema is the last part of the name of each topic.
    cls = SCHEMAS[topic["schema"]]
    fields = {field: kind_text(kind) for field, kind in wire_fields(cls).items()}
    # A program of another language connects to it.
    address = graph.nodes[topic["publisher"]].endpoint
    kind = "a stream"
    if topic["latched"]:
        kind = "state: latched"
    properties = {
        "schema": f"{cls.schema}, version {cls.version}",
        "about": about(cls),
        "kind": kind,
        "publisher": f"{topic['publisher']}, {topic['sent']} sent",
        "address": address,
        "clock offset": f"{graph.offset_ns} ns",
    }
    rows = []
    for reader in topic["subscribers"]:
        counts = [reader[count] for count in COUNTED]
        rows.append([reader["node"], *counts])
    lines = [name, *facts(properties, "  "), ""]
    head = ["SUBSCRIBER", *(count.upper() for count in COUNTED)]
    lines += [*table(head, rows, "  "), ""]
    lines += table(["FIELD", "TYPE"], list(fields.items()), "  ")

    document = {
        "graph": graph.label,
        **topic,
        "version": cls.version,
        "about": about(cls),
        "address": address,
        "clock_offset_ns": graph.offset_ns,
        "fields": fields,
    }
    return show(arguments, "topic-info", document, lines)


def _echo(arguments: argparse.Namespace) -> int:
    """Print the messages of a topic, of arrays a summary. Those that are not shown are counted;
    contacts with an event are always shown.
    """
    from sparseskin.launch.attach.echo import Echo, FieldPath
    from sparseskin.launch.attach.stream import observe, unit_of
    from sparseskin.messages import Contacts
    from sparseskin.messages.wire import SCHEMAS

    graph = choose_graph(arguments.graph)
    topic = find_topic(graph, arguments.topic)
    cls = SCHEMAS[topic.rpartition("/")[2]]
    field = None
    if arguments.field is not None:
        field = FieldPath(arguments.field, cls)
    n = arguments.n
    if arguments.once:
        n = 1
    # A few messages are over before reading them could disturb a graph.
    if n is None or n > FEW_MESSAGES:
        give_way()
    # Forces of contacts are printed with their unit, which the skin states.
    unit = ""
    if cls is Contacts:
        unit = unit_of(graph, topic)
    echo = Echo(
        topic,
        field,
        n=n,
        max_hz=arguments.max_hz,
        in_json=arguments.json,
        full=arguments.full,
        unit=unit,
    )
    return observe(graph, topic, echo, n, arguments.duration)


def _hz(arguments: argparse.Namespace) -> int:
    """Print the rate at which messages are sent and at which they arrive here, by their numbers and
    stamps; the bytes a second; their age on arrival, from the acquisition of the frame; and how
    many were lost on the way: a line a second, over the last messages, and at the end, or with
    Ctrl-C, one over all. It gives way to the graph, so that ages are longer than those of a node on
    a busy host; with -n it reads as a node does.
    """
    from sparseskin.launch.attach.rates import Meter
    from sparseskin.launch.attach.stream import observe

    graph = choose_graph(arguments.graph)
    topic = find_topic(graph, arguments.topic)
    # A stated number is measured as a node would: it does not give way.
    if arguments.n is None:
        give_way()
    meter = Meter(graph, topic, arguments.json)
    return observe(graph, topic, meter, arguments.n, arguments.duration)


def give_way() -> None:
    """Let this command run only where the graph leaves it room."""
    with contextlib.suppress(OSError):
        # SCHED_IDLE may not be allowed; a low priority always is.
        os.nice(19)
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def about(cls: "type[Message]") -> str:
    """The first paragraph of the docstring of a message class."""
    return flowing((cls.__doc__ or "").partition("\n\n")[0])


def kind_text(kind: "FieldKind") -> str:
    """Type of a field, in a few words."""
    import numpy as np

    from sparseskin.messages.fields import Array, Each, Samples, Text

    match kind:
        case Text():
            return f"text of at most {kind.longest} characters"
        case Each():
            return f"{kind_text(kind.kind)}, of each patch"
        case Samples():
            return "array of float32, 2 dimensions; or of whole numbers of few bits and a step"
        case Array():
            sides = f"{kind.ndim} dimensions"
            if kind.ndim == 1:
                sides = "1 dimension"
            text = f"array of {np.dtype(kind.dtype)}, {sides}"
        case _:
            text = WORDS[type(kind).__name__]
    if getattr(kind, "optional", False):
        text += " or none"
    return text
