"""The command `sparseskin monitor`: another monitor beside a running graph."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from typing import Any

from sparseskin.messages.topics import split_topic
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.graph import Link
from sparseskin.nodes.monitor.node import WATCHED
from sparseskin.nodes.monitor.table import summary_table

from .launcher import Launcher
from .launchfile import single_node
from .running import choose_graph
from .terminal import Terminal


def add_monitor_parser(commands: Any) -> None:
    """Add `monitor` to the commands."""
    parser = commands.add_parser(
        "monitor",
        help="watch a running graph",
        description="Watch a running graph on a live page, or in this terminal, until it ends "
        "or Ctrl-C.",
    )
    parser.add_argument("--text", action="store_true", help="in this terminal, without a page")
    parser.add_argument("--open", action="store_true", help="open the page in a browser")
    parser.add_argument("--port", type=int, help="port of the page on 127.0.0.1; 8470 by default")
    parser.add_argument("--graph", metavar="NAME", help="which graph, where several run")
    parser.set_defaults(run=monitor)


def monitor(arguments: argparse.Namespace) -> int:
    """Run a monitor beside a running graph."""
    if arguments.text and (arguments.open or arguments.port is not None):
        raise SettingsError("--text: goes with neither --open nor --port: it has no page")
    graph = choose_graph(arguments.graph)
    writers = graph.writers()
    watched = {schema.schema for schema in WATCHED}
    topics = [topic for topic in writers if split_topic(topic)[1] in watched]
    patches = list(dict.fromkeys(split_topic(topic)[0] for topic in topics))
    if not patches:
        raise SettingsError(f"{graph.label}: has no topic that a monitor reads")
    name = f"monitor_{os.getpid()}"
    values = {
        "patches": patches,
        "page": not arguments.text,
        "screen": arguments.text,
        "browser": arguments.open,
    }
    if arguments.port is not None:
        values["port"] = arguments.port
    launch = single_node(name, "monitor", values)
    links = [Link(topic, writers[topic], name) for topic in topics]
    launcher = Launcher(replace(launch, links=links), Terminal(), joined=graph)
    code = launcher.run()
    found = launcher.summary()["patches"]
    if found:
        print(summary_table(found))
    return code
