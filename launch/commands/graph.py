"""The commands `sparseskin graph list` and `stop`: the graphs that run on this host."""

from __future__ import annotations

import argparse

from sparseskin.launch.run.running import choose_graph, running_graphs, wait_for_end

from .options import add_commands, show


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `graph`."""
    add = add_commands(parser, "The graphs that run on this host.")
    listing = add("list", _list, "list the graphs")
    listing.add_argument("--json", action="store_true", help="print one JSON document")


def _list(arguments: argparse.Namespace) -> int:
    """List the running graphs of this user: name, process of the launcher, nodes; "(starting)" of
    one that is not ready.
    """
    from sparseskin.launch.attach.text import table

    # In this order: one that has started in between is among those that run.
    starting = running_graphs(starting=True)
    graphs = running_graphs()
    running = {graph.pid for graph in graphs}
    graphs += [graph for graph in starting if graph.pid not in running]
    rows = [[g.name, g.pid, ", ".join(g.nodes) or "(starting)"] for g in graphs]
    lines = table(["GRAPH", "PID", "NODES"], rows) if graphs else ["no graph runs on this host"]
    described = [
        {"name": g.name, "pid": g.pid, "nodes": list(g.nodes), "starting": not g.nodes}
        for g in graphs
    ]
    return show(arguments, "graph-list", {"graphs": described}, lines)


def configure_stop(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `stop`."""
    parser.description = (
        "End a running graph as Ctrl-C does: its sources stop, frames under way reach the end. A "
        "second stop ends all nodes at once."
    )
    about = "which graph, where several run on this host"
    parser.add_argument("graph", metavar="NAME|PID", nargs="?", help=about)
    parser.set_defaults(run=_stop)


def _stop(arguments: argparse.Namespace) -> int:
    from sparseskin.launch.attach.client import stop

    graph = choose_graph(arguments.graph, option="")
    stop(graph)
    wait_for_end(graph)
    print(f"{graph.label} has ended: {', '.join(graph.nodes)}")
    return 0
