"""The commands `sparseskin monitor` and `record`, nodes beside a running graph."""

import argparse
import fnmatch
import os
import sys
import time
from dataclasses import replace

from sparseskin.launch.attach.client import describe_node
from sparseskin.launch.run.running import RunningGraph, choose_graph
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.process.control import Document

from .options import add_graph, add_page, naming_options, print_ends, rare, whole


def configure_monitor(parser: argparse.ArgumentParser) -> None:
    place = "on a live page, or in this terminal"
    parser.description = f"Watch a running graph {place}, until it ends or Ctrl-C."
    parser.add_argument(
        "--text", action="store_true", help="in this terminal, without a page"
    )
    add_page(parser)
    rare(parser).add_argument(
        "--port", type=whole(0), help="port of the page on 127.0.0.1; 8470 by default"
    )
    add_graph(parser)
    parser.set_defaults(run=_monitor)


def configure_record(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Record topics of a running graph into an MCAP file, until it ends or Ctrl-C."
    )
    parser.add_argument(
        "topics",
        metavar="TOPIC",
        nargs="*",
        help="topics, all by default; * matches any text",
    )
    parser.add_argument(
        "--out", metavar="F.mcap", help="file to write; named by graph and time"
    )
    add_graph(parser)
    parser.set_defaults(run=_record)


def run_beside(
    graph: RunningGraph,
    type_name: str,
    name: str,
    values: Document,
    topics: list[str],
) -> tuple[int, Document]:
    """Run one node that reads topics of a running graph; return its exit code and its summary."""
    from sparseskin.launch.launchfile.load import single_node
    from sparseskin.launch.run.launcher import Launcher
    from sparseskin.launch.run.terminal import Terminal
    from sparseskin.nodes.graph import Link

    writers = graph.writers()
    # It reads what it needs, and nothing of the graph reads it.
    links = [Link(topic, writers[topic], name) for topic in topics]
    # A graph of one node, which joins the running one.
    launch = replace(single_node(name, type_name, values), links=links)
    launcher = Launcher(launch, Terminal(), joined=graph)
    return launcher.run(), launcher.summary()


def batches_of(graph: RunningGraph) -> dict[str, list[str]]:
    """Names of the patches of each batch that a running graph publishes, by the name of the batch.
    Raises GraphError if the graph does not answer.
    """
    from sparseskin.messages.topics import split_topic
    from sparseskin.nodes.recorder.bag.frames import FRAME_SCHEMAS

    writers = {}
    for topic, node in graph.writers().items():
        patch, schema = split_topic(topic)
        if schema in FRAME_SCHEMAS:
            writers[patch] = node

    # Names of the patches of a batch are settings of the node that publishes it.
    batches = {}
    for batch, node in writers.items():
        for entry in describe_node(graph, node)["settings"]:
            if entry["key"] == "patches" and entry["value"]:
                batches[batch] = list(entry["value"])
    return batches


def _monitor(arguments: argparse.Namespace) -> int:
    from sparseskin.launch.attach.stream import EXIT_NOTHING
    from sparseskin.nodes.monitor.table import summary_table

    if arguments.text and (arguments.open or arguments.port is not None):
        raise SettingsError(
            "--text: goes with neither --open nor --port: it has no page"
        )
    graph = choose_graph(arguments.graph)
    patches, topics = _watched(graph)
    # A batch is shown as its patches.
    batches = batches_of(graph)
    values = {
        "patches": [patch for patch in patches if patch not in batches],
        "batches": batches or None,
        "page": not arguments.text,
        "screen": arguments.text,
        "browser": arguments.open,
        "token": not arguments.no_token,
    }
    if arguments.port is not None:
        values["port"] = arguments.port
    with naming_options({"port": "--port"}):
        code, summary = run_beside(
            graph, "monitor", f"monitor_{os.getpid()}", values, topics
        )

    if summary["patches"]:
        print(summary_table(graph.name, summary["patches"]))
    # A monitor that read nothing has failed, though it ended well.
    counts = [patch["frames"].values() for patch in summary["patches"].values()]
    if not any(map(any, counts)):
        return code or EXIT_NOTHING
    return code


def _watched(graph: RunningGraph) -> tuple[list[str], list[str]]:
    """Patches, or batches of them, and topics that a monitor reads, or SettingsError."""
    from sparseskin.messages.topics import split_topic
    from sparseskin.nodes.monitor.node import WATCHED

    schemas = {cls.schema for cls in WATCHED}
    patches: list[str] = []
    topics = []
    for topic in graph.writers():
        patch, schema = split_topic(topic)
        if schema in schemas:
            topics.append(topic)
            patches.append(patch)
    if not patches:
        raise SettingsError(f"{graph.label}: has no topic that a monitor reads")
    return list(dict.fromkeys(patches)), topics


def _record(arguments: argparse.Namespace) -> int:
    from sparseskin.launch.attach.stream import EXIT_NOTHING

    graph = choose_graph(arguments.graph)
    topics = _matching(graph, arguments.topics or ["*"])
    out = arguments.out or f"{graph.name}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
    name = f"record_{os.getpid()}"
    values = {
        "out": out,
        "topics": topics,
        "launch": graph.launch,
        "source": graph.name,
    }
    with naming_options({"out": "--out"}):
        code, summary = run_beside(graph, "recorder", name, values, topics)
    print_ends(summary["nodes"])
    # The recorder was ended before it had opened its file.
    if code == 0 and "recording" not in summary["nodes"][name]:
        print(
            f"{out}: nothing was recorded: the recorder had not started yet",
            file=sys.stderr,
        )
        return EXIT_NOTHING
    return code


def _matching(graph: RunningGraph, patterns: list[str]) -> list[str]:
    """Topics that match one of some patterns; SettingsError if a pattern matches none."""
    writers = graph.writers()
    # A pattern without a topic is rather a typing error than a wish.
    for pattern in patterns:
        if not fnmatch.filter(writers, pattern):
            hint = did_you_mean(pattern, writers)
            raise SettingsError(f"{pattern}: {graph.label} has no such topic{hint}")
    topics = []
    for topic in writers:
        if any(fnmatch.fnmatchcase(topic, pattern) for pattern in patterns):
            topics.append(topic)
    return topics
