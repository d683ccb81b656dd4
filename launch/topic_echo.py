"""The command `sparseskin topic echo`: the messages of a topic, as text or JSON."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

from sparseskin.messages import Message, MessageError, decode
from sparseskin.messages.base import wire_fields
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import SCHEMAS

from .give_way import give_way
from .inspection import add_graph_option, find_topic
from .message_text import INDENT, FieldPath, plain, text
from .running import choose_graph
from .text_table import wrapped
from .topic_options import add_end_options, rate
from .topic_stream import Losses, TopicStream, why_quiet

MAX_HZ = 10.0
PATIENCE_S = 0.2
EXIT_NOTHING = 1


def add_echo_parser(kinds: Any) -> None:
    """Add `echo` to the commands of `topic`."""
    parser = kinds.add_parser(
        "echo",
        help="print messages",
        description="Print the messages of a topic, of arrays a summary. What is not shown is "
        "counted.",
    )
    parser.add_argument("topic", metavar="TOPIC", help="the topic, /PATCH/SCHEMA")
    parser.add_argument("--once", action="store_true", help="end after one message")
    add_end_options(parser)
    parser.add_argument("--full", action="store_true", help="print all elements of arrays")
    parser.add_argument(
        "--field", metavar="FIELD", help="print one field; FIELD[I,J]: one element of an array"
    )
    parser.add_argument(
        "--max-hz",
        metavar="R",
        type=rate,
        help=f"print R messages a second at most, 0: all (default: {MAX_HZ:g}; all with --json "
        "or -n)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object a line")
    add_graph_option(parser)
    parser.set_defaults(run=_echo)


class _Printer:
    """Prints messages, not more often than is wanted."""

    def __init__(self, arguments: argparse.Namespace, field: FieldPath | None) -> None:
        max_hz = arguments.max_hz
        if max_hz is None:
            max_hz = 0.0 if arguments.json or arguments.n is not None else MAX_HZ
        self._period_ns = round(1e9 / max_hz) if max_hz else 0
        self.patience_s = min(PATIENCE_S, self._period_ns / 1e9 or PATIENCE_S)
        self._arguments = arguments
        self._field = field
        self._due_ns = 0
        self.shown = self.skipped = 0
        self._skipped_since = 0

    def wants(self, stamp_ns: int) -> bool:
        """Whether a message of that stamp is printed; it is counted otherwise."""
        # Stamps go back where a recording is played again.
        if not self._due_ns - self._period_ns <= stamp_ns < self._due_ns:
            self._due_ns = stamp_ns + self._period_ns
            return True
        self.skipped += 1
        self._skipped_since += 1
        return False

    def print(self, message: Message) -> None:
        full = self._arguments.full
        if self._arguments.json:
            line = json.dumps(self._plain(message, full))
        elif self._field is not None:
            line = text(self._field.of(message), full)
        else:
            more = f" ({self._skipped_since} not shown)" if self._skipped_since else ""
            rows = [f"---{more}"]
            for name in _names(message):
                first, *rest = text(getattr(message, name), full).split("\n")
                rows += [*wrapped(f"{name}: ", first, INDENT), *(INDENT + one for one in rest)]
            line = "\n".join(rows)
        print(line, flush=True)
        self.shown += 1
        self._skipped_since = 0

    def _plain(self, message: Message, full: bool) -> Any:
        if self._field is not None:
            return plain(self._field.of(message), full)
        values = {name: plain(getattr(message, name), full) for name in _names(message)}
        return {"topic": message.topic, **values}


def _names(message: Message) -> list[str]:
    return list(wire_fields(type(message)))


def _echo(arguments: argparse.Namespace) -> int:
    graph = choose_graph(arguments.graph)
    topic = find_topic(graph, arguments.topic)
    cls = SCHEMAS[split_topic(topic)[1]]
    field = FieldPath(arguments.field, cls) if arguments.field is not None else None
    wanted = 1 if arguments.once else arguments.n
    printer, losses = _Printer(arguments, field), Losses()
    give_way()
    done = ended = False
    refused = 0
    with TopicStream(graph, topic, printer.patience_s if wanted is None else 0.0) as stream:
        for arrivals in stream.batches(arguments.duration):
            for arrival in arrivals:
                losses.take(arrival)
                ended = arrival.ends
                if not ended and printer.wants(arrival.stamp_ns):
                    try:
                        printer.print(decode(arrival.topic, arrival.payload))
                    except MessageError as error:
                        refused += 1
                        print(f"{topic}: {error}", file=sys.stderr)
                done = ended or printer.shown == wanted
                if done:
                    break
            if done:
                break
    if ended:
        print(f"{topic}: the stream has ended", file=sys.stderr)
    if not printer.shown:
        print(f"{topic}: no message came{why_quiet(graph, topic)}", file=sys.stderr)
        return EXIT_NOTHING
    if wanted is None:
        counts = f"{printer.shown} shown, {printer.skipped} not shown, {losses.n} lost"
        print(f"{topic}: {counts}", file=sys.stderr)
    return 0
