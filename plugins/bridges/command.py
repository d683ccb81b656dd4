"""The command `sparseskin bridge`: a node beside a running graph that shows it to another tool."""

import argparse
import os
from typing import Any

from sparseskin.launch.commands.observers import run_beside
from sparseskin.launch.commands.options import (
    add_commands,
    add_graph,
    add_set,
    naming_options,
    print_ends,
    stated_values,
    whole,
)
from sparseskin.launch.run.running import choose_graph
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.extensions import NODES, loaded
from sparseskin.nodes.lookup import did_you_mean

from .base import Bridge, patches_of


def bridges() -> dict[str, type[Bridge[Any]]]:
    """Bridges by the names of their types of nodes, of this package and of others."""
    return {
        name: cls
        for name, cls in loaded(NODES).items()
        if isinstance(cls, type) and issubclass(cls, Bridge)
    }


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `bridge`."""
    add = add_commands(
        parser,
        "Show a running graph to another tool, until it ends or Ctrl-C. A bridge slows no node "
        "down: where it is behind, the oldest messages are dropped and counted.",
    )
    for name, cls in bridges().items():
        command = add(name, _bridge, cls.HELP)
        about = cls.HELP[0].upper() + cls.HELP[1:]
        command.description = f"{about}, until it ends or Ctrl-C."
        command.set_defaults(bridge=name)
        # Bridges that serve clients get their port as an option of its own.
        if "port" in {entry["key"] for entry in cls.Settings.described()}:
            command.add_argument(
                "--port", type=whole(0), help="port of 127.0.0.1; 0: a free one"
            )
        add_set(command, "another setting of the bridge, see docs/howto/bridges.md")
        add_graph(command)


def _bridge(arguments: argparse.Namespace) -> int:
    from sparseskin.launch.attach.stream import EXIT_NOTHING

    cls = bridges()[arguments.bridge]
    values = stated_values(arguments.set, cls.Settings.described())
    if getattr(arguments, "port", None) is not None:
        values["port"] = arguments.port

    graph = choose_graph(arguments.graph)
    writers = graph.writers()
    # By default, all that the graph publishes is shown.
    patches = values.setdefault("patches", patches_of(writers))
    if not patches:
        raise SettingsError(
            f"{graph.label}: publishes no skin that a bridge could show"
        )
    settings = cls.Settings.from_mapping(values)
    for topic in cls.inputs(settings):
        if topic not in writers:
            patch, _ = split_topic(topic)
            hint = did_you_mean(patch, patches_of(writers))
            raise SettingsError(f"patches: {graph.label} has no {patch!r}{hint}")

    # Those of its topics that this graph publishes.
    read = {*cls.inputs(settings), *cls.optional_inputs(settings)}
    topics = [topic for topic in writers if topic in read]
    # Two bridges of one kind may run beside one graph.
    name = f"{arguments.bridge}_{os.getpid()}"
    with naming_options({"port": "--port"}):
        # A port that is taken is reported by the option that states it.
        code, summary = run_beside(graph, arguments.bridge, name, values, topics)
    print_ends(summary["nodes"])
    # A bridge that sent nothing has failed, though it ended well.
    sent = summary["nodes"][name].get("bridge", {}).get("sent", 0)
    if not sent:
        return code or EXIT_NOTHING
    return code
