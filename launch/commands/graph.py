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
from sparseskin.nodes.process.control import COUNTED
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
    rows = [[g.name, g.pid, ", ".join(g.nodes) or "(starting)"] for g in graphs]
    lines = table(["GRAPH", "PID", "NODES"], rows) if graphs else ["no graph runs on this host"]
    described = [
        {"name": g.name, "pid": g.pid, "nodes": list(g.nodes), "starting": not g.nodes}
        for g in graphs
    ]
    return show(arguments, "graph-list", {"graphs": described}, lines)


def configure_stop(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "End a running graph as Ctrl-C does: its sources stop, frames under way reach the end. A "
        "second stop ends all nodes at once."
    )
    about = "which graph, where several run on this host"
    parser.add_argument("graph", metavar="NAME|PID", nargs="?", help=about)
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
    for one in (listing, info):
        add_graph(one, "one JSON document")


def _list_nodes(arguments: argparse.Namespace) -> int:
    """List the nodes of a running graph: type, condition, process, restarts."""
    graph = choose_graph(arguments.graph)
    described = describe(graph)
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
    if node["host"] == socket.gethostname():
        with contextlib.suppress(OSError):  # the process is gone
            used_s = cpu_s(node["pid"])
            node |= {
                "cpu_s": used_s,
                "cpu_percent": round(100 * used_s / age_s(node["pid"]), 1),
                "memory_mb": round(resident_bytes(node["pid"]) / 1e6, 1),
            }
    topics = topics_of(described)
    for entry in node["inputs"]:
        entry["publisher"] = topics[entry["topic"]]["publisher"]
    for entry in node["outputs"]:
        entry["subscribers"] = [one["node"] for one in topics[entry["topic"]]["subscribers"]]
    return show(arguments, "node-info", node, _node_text(node))


def _node_text(node: dict[str, Any]) -> list[str]:
    restarts = f", restarted {node['restarts']} times" if node["restarts"] else ""
    shared = f", with {', '.join(node['companions'])}" if node["companions"] else ""
    named = {
        "type": node["type"],
        "condition": node["condition"] + restarts,
        "process": f"{node['pid']} on {node['host']}{shared}",
        "transport": f"{node['transport']} (ZeroMQ)",
    }
    if "cpu_s" in node:
        shares = f"{node['cpu_percent']:.1f} % of a core since it started"
        named["uses"] = f"{shares}, {node['memory_mb']:.0f} MB of memory"
    if node["line"]:
        named["reports"] = node["line"]
    if node["refused"]:
        counts = ", ".join(f"{reason} {n}" for reason, n in node["refused"].items())
        named["refused"] = f"{counts}; the last: {node['refusal']}"
    preset = preset_of(node["settings"])
    tables: dict[tuple[str, ...], list[list[Any]]] = {
        ("INPUT", "FROM", *(what.upper() for what in COUNTED)): [
            [e["topic"], e["publisher"] or ELSEWHERE, *(e[what] for what in COUNTED)]
            for e in node["inputs"]
        ],
        ("OUTPUT", "SENT", "READ BY"): [
            [e["topic"], e["sent"], ", ".join(e["subscribers"])] for e in node["outputs"]
        ],
        ("STATE", "VALUE"): [[key, shown_value(value)] for key, value in node["state"].items()],
        ("COMMAND", "ACTION"): [[*command] for command in node["commands"].items()],
        ("SETTING", "", "VALUE"): [
            [e["key"], "live" * e["live"], shown_value(e["value"]) + in_force_text(e, preset)]
            for e in node["settings"]
        ],
    }
    lines = [node["name"], *facts(named, "  ")]
    for head, rows in tables.items():
        lines += ["", *table(head, rows, "  ")] if rows else []
    return lines


def configure_param(parser: argparse.ArgumentParser) -> None:
    add = add_commands(parser, "The settings of the nodes of a graph that runs on this host.")
    listing = add("list", _list_settings, "list settings, and what each may be")
    listing.add_argument("node", metavar="NODE", nargs="?", help="name of a node; all by default")
    get = add("get", _get, "print one setting")
    change = add("set", _set, "set one setting, or several at once")
    for one in (get, change):
        one.add_argument("node", metavar="NODE", help="name of the node")
        one.add_argument("key", metavar="KEY", help="name of the setting")
    change.add_argument("value", metavar="VALUE", help="as in a launch file; none: not stated")
    change.add_argument("more", metavar="KEY VALUE", nargs="*", default=[], help="further settings")
    for one in (listing, get, change):
        add_graph(one, "one JSON document")


def _list_settings(arguments: argparse.Namespace) -> int:
    """List the settings of one node or of all, what each may be and what it means. Those marked
    live can be set while the graph runs.
    """
    graph = choose_graph(arguments.graph)
    named = arguments.node
    names = [node["name"] for node in describe(graph)["nodes"]] if named is None else [named]
    settings = {name: describe_node(graph, name)["settings"] for name in names}
    lines = "\n\n".join("\n".join(_node_lines(name, settings[name])) for name in names)
    return show(arguments, "param-list", {"graph": graph.label, "nodes": settings}, [lines])


def _node_lines(name: str, entries: list[dict[str, Any]]) -> list[str]:
    """Two lines a setting at the least: its value and what it may be, then what it means."""
    widest = max((len(entry["key"]) for entry in entries), default=0)
    preset = preset_of(entries)
    lines = [f"{name} (* can be set while the graph runs)"]
    for entry in entries:
        start = f"{'* ' if entry['live'] else '  '}{entry['key']:<{widest}} = "
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
    value = entries[key]["value"]
    in_force = in_force_text(entries[key], preset_of(settings))
    text = value if isinstance(value, str) else shown_value(value) + in_force
    document = {"node": node, **entries[key]}
    return show(arguments, "param-get", document, map(printable, text.split("\n")))


def _set(arguments: argparse.Namespace) -> int:
    """Set live settings of a node, all or none of them, between two frames. The node checks them; a
    refusal is one line, with exit code 2.
    """
    if len(arguments.more) % 2:
        raise SettingsError(f"{arguments.more[-1]}: a setting without a value")
    typed = dict(zip(arguments.more[::2], arguments.more[1::2], strict=True))
    typed = {arguments.key: arguments.value} | typed
    graph = choose_graph(arguments.graph)
    entries = {entry["key"]: entry for entry in describe_node(graph, arguments.node)["settings"]}
    values: dict[str, Any] = {}
    for key, text in typed.items():
        table, dot, part = key.partition(".")
        if dot and table in entries:  # one value of a table: the others stay
            before = values.get(table, entries[table]["value"])
            kept = before if isinstance(before, dict) else {}
            values[table] = {**kept, part: typed_value(text, None)}
        else:
            values[key] = typed_value(text, entries.get(key))
    answer = ask_node(graph, arguments.node, "set", values)
    done = {"node": arguments.node, "set": values, "answer": answer}
    return show(arguments, "param-set", done, [f"{arguments.node}: {answer}"])
