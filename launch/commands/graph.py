"""The commands about a running graph: `graph list`, `stop`, `node` and `param`."""

import argparse
import contextlib
import socket
from typing import Any

from sparseskin.launch.attach.client import (
    ELSEWHERE,
    ask_node,
    describe,
    describe_node,
    stop,
    topics_of,
)
from sparseskin.launch.attach.text import (
    allowed_text,
    facts,
    flowing,
    in_force_text,
    preset_of,
    shown_value,
    table,
    typed_value,
    wrapped,
)
from sparseskin.launch.run.running import GraphError, choose_graph, running_graphs
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.process.control import COUNTED, Document
from sparseskin.nodes.process.proc import age_s, cpu_s, resident_bytes

from .options import add_commands, add_graph, show


def configure_graph(parser: argparse.ArgumentParser) -> None:
    add = add_commands(parser, "The graphs that run on this host.")
    listing = add("list", _list_graphs, "list the graphs")
    listing.add_argument("--json", action="store_true", help="print one JSON document")


def _list_graphs(arguments: argparse.Namespace) -> int:
    """List the running graphs of this user: name, process of the launcher, nodes; "(starting)" of
    one that is not ready.
    """
    graphs = running_graphs(starting=True)
    rows = []
    described = []
    for graph in graphs:
        nodes = list(graph.nodes)
        names = ", ".join(nodes)
        # A graph that starts has stated none yet.
        rows.append([graph.name, graph.pid, names or "(starting)"])
        described.append(
            {
                "name": graph.name,
                "pid": graph.pid,
                "nodes": nodes,
                "starting": not nodes,
            }
        )
    lines = ["no graph runs on this host"]
    if rows:
        lines = table(["GRAPH", "PID", "NODES"], rows)
    return show(arguments, "graph-list", {"graphs": described}, lines)


def configure_stop(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "End a running graph as Ctrl-C does: its sources stop, frames under way reach the end. A "
        "second stop ends all nodes at once."
    )
    parser.add_argument(
        "graph",
        metavar="NAME|PID",
        nargs="?",
        help="which graph, where several run on this host",
    )
    parser.set_defaults(run=_stop)


def _stop(arguments: argparse.Namespace) -> int:
    graph = choose_graph(arguments.graph, option="")
    stop(graph)
    print(f"{graph.label} has ended: {', '.join(graph.nodes)}")
    return 0


def configure_node(parser: argparse.ArgumentParser) -> None:
    add = add_commands(parser, "The nodes of a graph that runs on this host.")
    listing = add("list", _list_nodes, "list the nodes")
    info = add("info", _info, "describe one node")
    info.add_argument("node", metavar="NODE", help="name of the node")
    for command in (listing, info):
        add_graph(command, "one JSON document")


def _list_nodes(arguments: argparse.Namespace) -> int:
    """List the nodes of a running graph: type, condition, process, restarts."""
    graph = choose_graph(arguments.graph)
    described = describe(graph)
    # Settings and topics of a node are shown by `node info`.
    keys = ("name", "type", "condition", "pid", "restarts")
    nodes = [{key: node[key] for key in keys} for node in described["nodes"]]
    head = ["NODE", "TYPE", "CONDITION", "PID", "RESTARTS"]
    lines = table(head, [list(node.values()) for node in nodes])
    return show(arguments, "node-list", {"graph": graph.label, "nodes": nodes}, lines)


def _info(arguments: argparse.Namespace) -> int:
    """Describe one node: its process, its topics and what it counted on each, its commands, its
    settings.
    """
    graph = choose_graph(arguments.graph)
    node = describe_node(graph, arguments.node)
    described = describe(graph)
    node["host"] = described["host"]
    # Only processes of this host can be looked at.
    if node["host"] == socket.gethostname():
        with contextlib.suppress(OSError):
            # The process is gone.
            node |= _process_figures(node["pid"])

    # The other ends of its topics are known to the graph alone.
    topics = topics_of(described)
    for entry in node["inputs"]:
        entry["publisher"] = topics[entry["topic"]]["publisher"]
    for entry in node["outputs"]:
        readers = topics[entry["topic"]]["subscribers"]
        entry["subscribers"] = [reader["node"] for reader in readers]
    return show(arguments, "node-info", node, _node_text(node))


def _process_figures(pid: int) -> dict[str, float]:
    """Time on a processor, seconds and % of the age, and memory of a process, MB."""
    used_s = cpu_s(pid)
    percent = 100 * used_s / age_s(pid)
    memory_mb = resident_bytes(pid) / 1e6
    return {
        "cpu_s": used_s,
        "cpu_percent": round(percent, 1),
        "memory_mb": round(memory_mb, 1),
    }


def _node_text(node: Document) -> list[str]:
    lines = [node["name"], *facts(_node_properties(node), "  ")]
    for head, rows in _node_tables(node).items():
        if rows:
            lines += ["", *table(head, rows, "  ")]
    return lines


def _node_properties(node: Document) -> dict[str, str]:
    condition = node["condition"]
    if node["restarts"]:
        condition += f", restarted {node['restarts']} times"
    process = f"{node['pid']} on {node['host']}"
    if node["companions"]:
        process += f", with {', '.join(node['companions'])}"
    properties = {
        "type": node["type"],
        "condition": condition,
        "process": process,
        "transport": f"{node['transport']} (ZeroMQ)",
    }
    if "cpu_s" in node:
        share = f"{node['cpu_percent']:.1f} % of a core since it started"
        properties["uses"] = f"{share}, {node['memory_mb']:.0f} MB of memory"
    if node["line"]:
        properties["reports"] = node["line"]
    if node["refused"]:
        # Refused messages by their reason.
        by_reason = [f"{reason} {n}" for reason, n in node["refused"].items()]
        counts = ", ".join(by_reason)
        properties["refused"] = f"{counts}; the last: {node['refusal']}"
    return properties


def _node_tables(node: Document) -> dict[tuple[str, ...], list[list[Any]]]:
    """Rows of each table about a node, by the head of the table."""
    inputs = []
    for entry in node["inputs"]:
        counts = [entry[count] for count in COUNTED]
        inputs.append([entry["topic"], entry["publisher"] or ELSEWHERE, *counts])
    outputs = []
    for entry in node["outputs"]:
        outputs.append([entry["topic"], entry["sent"], ", ".join(entry["subscribers"])])
    settings = []
    preset = preset_of(node["settings"])
    for entry in node["settings"]:
        mark = ""
        if entry["live"]:
            # It can be set while the graph runs.
            mark = "live"
        value = shown_value(entry["value"]) + in_force_text(entry, preset)
        settings.append([entry["key"], mark, value])
    state = []
    for key, value in node["state"].items():
        state.append([key, shown_value(value)])
    commands = [list(command) for command in node["commands"].items()]
    return {
        ("INPUT", "FROM", *(count.upper() for count in COUNTED)): inputs,
        ("OUTPUT", "SENT", "READ BY"): outputs,
        ("STATE", "VALUE"): state,
        ("COMMAND", "ACTION"): commands,
        ("SETTING", "", "VALUE"): settings,
    }


def configure_param(parser: argparse.ArgumentParser) -> None:
    add = add_commands(
        parser, "The settings of the nodes of a graph that runs on this host."
    )
    listing = add("list", _list_settings, "list settings, and what each may be")
    listing.add_argument(
        "node",
        metavar="NODE",
        nargs="?",
        help="name of a node; all by default",
    )
    get = add("get", _get, "print one setting")
    change = add("set", _set, "set one setting, or several at once")
    for command in (get, change):
        command.add_argument("node", metavar="NODE", help="name of the node")
        command.add_argument("key", metavar="KEY", help="name of the setting")
    change.add_argument(
        "value", metavar="VALUE", help="as in a launch file; none: not stated"
    )
    change.add_argument(
        "more",
        metavar="KEY VALUE",
        nargs="*",
        default=[],
        help="further settings",
    )
    for command in (listing, get, change):
        add_graph(command, "one JSON document")


def _list_settings(arguments: argparse.Namespace) -> int:
    """List the settings of one node or of all, what each may be and what it means. Those marked
    live can be set while the graph runs.
    """
    graph = choose_graph(arguments.graph)
    names = [arguments.node]
    if arguments.node is None:
        names = [node["name"] for node in describe(graph)["nodes"]]
    settings = {name: describe_node(graph, name)["settings"] for name in names}
    tables = ["\n".join(_node_lines(name, settings[name])) for name in names]
    document = {"graph": graph.label, "nodes": settings}
    return show(arguments, "param-list", document, ["\n\n".join(tables)])


def _node_lines(name: str, entries: list[Document]) -> list[str]:
    """Two lines a setting at the least: its value and what it may be, then what it means."""
    # Values of all settings begin in one column.
    widest = max((len(entry["key"]) for entry in entries), default=0)
    # A setting that is not stated may have a value by the preset.
    preset = preset_of(entries)
    lines = [f"{name} (* can be set while the graph runs)"]
    for entry in entries:
        mark = " "
        if entry["live"]:
            mark = "*"
        start = f"{mark} {entry['key']:<{widest}} = "
        value = flowing(shown_value(entry["value"]) + in_force_text(entry, preset))
        lines += wrapped(start, f"{value}   ({allowed_text(entry)})")
        lines += wrapped(" " * len(start), flowing(entry["doc"]))
    return lines


def _get(arguments: argparse.Namespace) -> int:
    """Print the value of one setting, and the one in force where none is stated."""
    node = arguments.node
    key = arguments.key
    settings = describe_node(choose_graph(arguments.graph), node)["settings"]
    entries = {entry["key"]: entry for entry in settings}
    if key not in entries:
        raise GraphError(f"{node}: {key}: no such setting{did_you_mean(key, entries)}")

    # A text is printed as it is, for a script to use.
    text = entries[key]["value"]
    if not isinstance(text, str):
        text = shown_value(text)
        text += in_force_text(entries[key], preset_of(settings))
    document = {"node": node, **entries[key]}
    return show(arguments, "param-get", document, map(printable, text.split("\n")))


def _set(arguments: argparse.Namespace) -> int:
    """Set live settings of a node, all or none of them, between two frames. The node checks them; a
    refusal is one line, with exit code 2.
    """
    if len(arguments.more) % 2:
        raise SettingsError(f"{arguments.more[-1]}: a setting without a value")
    # All of them go in one request: all are set between two frames, or none.
    typed_texts = {arguments.key: arguments.value}
    words = iter(arguments.more)
    for key in words:
        typed_texts[key] = next(words)

    graph = choose_graph(arguments.graph)
    settings = describe_node(graph, arguments.node)["settings"]
    entries = {entry["key"]: entry for entry in settings}
    values: Document = {}
    for key, text in typed_texts.items():
        # A dot may also be part of the name of a setting.
        table_key, dot, part = key.partition(".")
        if not dot or table_key not in entries:
            values[key] = typed_value(text, entries.get(key))
            continue
        # One value of a table: the others stay.
        table_values = values.get(table_key, entries[table_key]["value"])
        if not isinstance(table_values, dict):
            table_values = {}
        values[table_key] = {**table_values, part: typed_value(text, None)}
    answer = ask_node(graph, arguments.node, "set", values)
    done = {
        "node": arguments.node,
        "set": values,
        "answer": answer,
    }
    return show(arguments, "param-set", done, [f"{arguments.node}: {answer}"])
