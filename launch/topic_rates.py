"""The commands `sparseskin topic hz|bw|delay`: a line a second, and one over all at the end."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from .give_way import give_way
from .inspection import add_graph_option, find_topic
from .running import choose_graph
from .topic_figures import (
    MAX_KEPT,
    Samples,
    bw_figures,
    bw_text,
    delay_figures,
    delay_text,
    hz_figures,
    hz_text,
)
from .topic_options import add_end_options, at_least_two
from .topic_stream import TopicStream, why_quiet

REPORT_S = 1.0
WINDOW = 1000
PATIENCE_S = 0.2
EXIT_NOTHING = 1


@dataclass(frozen=True)
class _Measure:
    """One of the three commands: its help, its figures, and those as text.

    Attributes
    ----------
    patience_s : float
        How long messages may wait to be taken in together, which takes less of the processor; 0
        for a measure that is of the arrival, which then does not give way to the graph either.
    """

    help: str
    description: str
    figures: Callable[..., dict[str, Any]]
    text: Callable[[dict[str, Any]], str]
    patience_s: float


_MEASURES = {
    "hz": _Measure(
        "how often messages are sent, and arrive here",
        "Print how often messages are sent and the interval between two, by their numbers and "
        "stamps, how often they arrive here, and how many were lost on the way.",
        hz_figures,
        hz_text,
        PATIENCE_S,
    ),
    "bw": _Measure(
        "how many bytes a second arrive here",
        "Print how many bytes a second arrive here, and the size of a message on the wire.",
        bw_figures,
        bw_text,
        PATIENCE_S,
    ),
    "delay": _Measure(
        "how old messages are when they arrive here",
        "Print the time from a message's stamp, the acquisition of its frame, to its arrival "
        "here, on the clock of this host. It reads as a node does, and on a host that is busy "
        "takes its time from the graph, as a node does.",
        delay_figures,
        delay_text,
        0.0,
    ),
}


def add_rate_parsers(kinds: Any) -> None:
    """Add hz, bw and delay to the commands of `topic`."""
    for kind, measure in _MEASURES.items():
        parser = kinds.add_parser(
            kind,
            help=measure.help,
            description=f"{measure.description} A line a second, over the last messages; at the "
            "end, or with Ctrl-C, one over all.",
        )
        parser.add_argument("topic", metavar="TOPIC", help="the topic, /PATCH/SCHEMA")
        parser.add_argument(
            "--window",
            metavar="K",
            type=at_least_two,
            default=WINDOW,
            help=f"how many messages a line is over, at most (default: {WINDOW})",
        )
        add_end_options(parser)
        parser.add_argument("--json", action="store_true", help="print one JSON object a line")
        add_graph_option(parser)
        parser.set_defaults(run=_rate, measure=measure)


class _Reports:
    """Prints the figures of one topic, as text or JSON."""

    def __init__(self, topic: str, measure: _Measure, in_json: bool) -> None:
        self._topic = topic
        self._measure = measure
        self._in_json = in_json
        self.samples = Samples()

    def print(self, window: int, final: bool) -> None:
        kept = self.samples.last(window)
        figures = self._measure.figures(kept)
        counts = {"messages": self.samples.n, "lost": self.samples.lost}
        if self._in_json:
            over = {"over": len(kept["seq"]), "final": final}
            print(json.dumps({"topic": self._topic, **counts, **figures, **over}), flush=True)
        else:
            measured = self._measure.text(figures) or "too few messages for a rate"
            line = f"{measured} | lost {self.samples.lost}"
            print(f"all {self.samples.n}: {line}" if final else line, flush=True)

    def say(self, line: str) -> None:
        """Something that is no figure."""
        if self._in_json:
            print(line, file=sys.stderr, flush=True)
        else:
            print(line, flush=True)


def _rate(arguments: argparse.Namespace) -> int:
    graph = choose_graph(arguments.graph)
    topic = find_topic(graph, arguments.topic)
    reports = _Reports(topic, arguments.measure, arguments.json)
    samples = reports.samples
    if arguments.measure.patience_s:
        give_way()
    done = ended = False
    reported_n, heard_s = 0, time.monotonic()
    report_at_s = heard_s + REPORT_S
    # Of a stated number of messages, the last ones are not to wait for more.
    patience_s = arguments.measure.patience_s if arguments.n is None else 0.0
    with TopicStream(graph, topic, patience_s) as stream:
        for arrivals in stream.batches(arguments.duration):
            for arrival in arrivals:
                samples.add(arrival)
                ended = arrival.ends
                done = ended or samples.n == arguments.n
                if done:
                    break
            if done:
                break
            now_s = time.monotonic()
            if arrivals:
                heard_s = now_s
            if now_s < report_at_s:
                continue
            report_at_s = max(report_at_s, now_s - REPORT_S) + REPORT_S
            if samples.n > reported_n:
                reported_n = samples.n
                reports.print(arguments.window, final=False)
            else:
                quiet = f"no message for {now_s - heard_s:.0f} s"
                reports.say(f"{topic}: {quiet}{why_quiet(graph, topic)}")
    if ended:
        reports.say(f"{topic}: the stream has ended")
    if not samples.n:
        print(f"{topic}: no message came{why_quiet(graph, topic)}", file=sys.stderr)
        return EXIT_NOTHING
    reports.print(MAX_KEPT, final=True)
    return 0
