"""The commands `sparseskin param ...`: the settings of a running graph's nodes."""

from __future__ import annotations

import argparse
import json
from typing import Any

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean

from .inspection import add_graph_option, ask_node, describe, describe_node
from .running import GraphError, RunningGraph, choose_graph
from .setting_text import allowed_text, in_force_text, preset_of, shown_value, typed_value
from .text_table import printable, wrapped


def add_param_parser(commands: Any) -> None:
    """Add `param` and its commands to the commands."""
    param = commands.add_parser(
        "param",
        help="list, get and set the settings of a running graph's nodes",
        description="The settings of the nodes of a graph that runs on this host.",
    )
    kinds = param.add_subparsers(required=True, metavar="COMMAND")
    listing = kinds.add_parser(
        "list",
        help="list settings, and what each may be",
        description="List the settings of one node or of all, what each may be and what it means. "
        "Those marked live can be set while the graph runs.",
    )
    listing.add_argument("node", metavar="NODE", nargs="?", help="name of a node; all by default")
    listing.set_defaults(run=_list)
    get = kinds.add_parser(
        "get", help="print one setting", description="Print the value of one setting."
    )
    get.add_argument("node", metavar="NODE", help="name of the node")
    get.add_argument("key", metavar="KEY", help="name of the setting")
    get.set_defaults(run=_get)
    change = kinds.add_parser(
        "set",
        help="set one setting, or several at once",
        description="Set live settings of a node, all or none of them, between two frames. The "
        "node checks them; what it refuses is said in one line, with exit code 2.",
    )
    change.add_argument("node", metavar="NODE", help="name of the node")
    change.add_argument("key", metavar="KEY", help="name of the setting")
    change.add_argument("value", metavar="VALUE", help="as in a launch file; none: not stated")
    change.add_argument("more", metavar="KEY VALUE", nargs="*", help="further settings")
    change.set_defaults(run=_set)
    for parser in (listing, get, change):
        parser.add_argument("--json", action="store_true", help="print one JSON document")
        add_graph_option(parser)


def _list(arguments: argparse.Namespace) -> int:
    graph = choose_graph(arguments.graph)
    if arguments.node is not None:
        names = [arguments.node]
    else:
        names = [node["name"] for node in describe(graph)["nodes"]]
    settings = {name: describe_node(graph, name)["settings"] for name in names}
    if arguments.json:
        print(json.dumps({"graph": graph.label, "nodes": settings}, indent=2))
        return 0
    print("\n\n".join("\n".join(_node_lines(name, settings[name])) for name in names))
    return 0


def _node_lines(name: str, entries: list[dict[str, Any]]) -> list[str]:
    """Two lines a setting at the least: its value and what it may be, then what it means."""
    widest = max((len(entry["key"]) for entry in entries), default=0)
    preset = preset_of(entries)
    lines = [f"{name} (* can be set while the graph runs)"]
    for entry in entries:
        start = f"{'* ' if entry['live'] else '  '}{entry['key']:<{widest}} = "
        value = printable(shown_value(entry["value"]) + in_force_text(entry, preset))
        lines += wrapped(start, f"{value}   ({allowed_text(entry)})")
        lines += wrapped(" " * len(start), printable(entry["doc"]))
    return lines


def _get(arguments: argparse.Namespace) -> int:
    graph = choose_graph(arguments.graph)
    entry = _entry(graph, arguments.node, arguments.key)
    if arguments.json:
        print(json.dumps({"node": arguments.node, **entry}, indent=2))
    else:
        value = entry["value"]
        print(value if isinstance(value, str) else shown_value(value))
    return 0


def _entry(graph: RunningGraph, node: str, key: str) -> dict[str, Any]:
    entries = {entry["key"]: entry for entry in describe_node(graph, node)["settings"]}
    if key not in entries:
        raise GraphError(f"{node}: {key}: no such setting{did_you_mean(key, entries)}")
    found: dict[str, Any] = entries[key]
    return found


def _set(arguments: argparse.Namespace) -> int:
    if len(arguments.more) % 2:
        raise SettingsError(f"{arguments.more[-1]}: a setting without a value")
    typed = dict(zip(arguments.more[::2], arguments.more[1::2], strict=True))
    typed = {arguments.key: arguments.value} | typed
    graph = choose_graph(arguments.graph)
    entries = {entry["key"]: entry for entry in describe_node(graph, arguments.node)["settings"]}
    values = {key: typed_value(text, entries.get(key)) for key, text in typed.items()}
    answer = ask_node(graph, arguments.node, "set", values)
    if not answer.done:
        raise GraphError(f"{arguments.node}: {printable(answer.text)}")
    if arguments.json:
        print(json.dumps({"node": arguments.node, "set": values, "answer": answer.text}, indent=2))
    else:
        print(f"{arguments.node}: {printable(answer.text)}")
    return 0
