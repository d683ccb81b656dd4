"""The commands `sparseskin node ...`: the nodes of a running graph."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import socket
from pathlib import Path
from typing import Any

from sparseskin.nodes.host import COUNTED

from .inspection import ELSEWHERE, add_graph_option, describe, describe_node, topics_of
from .running import choose_graph
from .setting_text import in_force_text, preset_of, shown_value
from .text_table import printable, table, wrapped


def add_node_parser(commands: Any) -> None:
    """Add `node` and its commands to the commands."""
    node = commands.add_parser(
        "node",
        help="list the nodes of a running graph, tell all of one",
        description="The nodes of a graph that runs on this host.",
    )
    kinds = node.add_subparsers(required=True, metavar="COMMAND")
    listing = kinds.add_parser(
        "list",
        help="list the nodes",
        description="List the nodes of a running graph: type, condition, process, restarts.",
    )
    listing.set_defaults(run=_list)
    info = kinds.add_parser(
        "info",
        help="tell all of one node",
        description="Tell all of one node: its process, its topics with what it counted on each, "
        "what it can be told to do, its settings.",
    )
    info.add_argument("node", metavar="NODE", help="name of the node")
    info.set_defaults(run=_info)
    for parser in (listing, info):
        parser.add_argument("--json", action="store_true", help="print one JSON document")
        add_graph_option(parser)


def _list(arguments: argparse.Namespace) -> int:
    graph = choose_graph(arguments.graph)
    described = describe(graph)
    keys = ("name", "type", "condition", "pid", "restarts")
    nodes = [{key: node[key] for key in keys} for node in described["nodes"]]
    if arguments.json:
        print(json.dumps({"graph": graph.label, "nodes": nodes}, indent=2))
        return 0
    rows = [list(node.values()) for node in nodes]
    print("\n".join(table(["NODE", "TYPE", "CONDITION", "PID", "RESTARTS"], rows)))
    return 0


def _info(arguments: argparse.Namespace) -> int:
    graph = choose_graph(arguments.graph)
    node = describe_node(graph, arguments.node)
    described = describe(graph)
    node["host"] = described["host"]
    node |= _resources(node["pid"]) if node["host"] == socket.gethostname() else {}
    topics = topics_of(described)
    for entry in node["inputs"]:
        entry["publisher"] = topics[entry["topic"]].publisher
    for entry in node["outputs"]:
        entry["subscribers"] = list(topics[entry["topic"]].readers)
    print(json.dumps(node, indent=2) if arguments.json else "\n".join(_text(node)))
    return 0


def _resources(pid: int) -> dict[str, float]:
    """Processor time that a process has used, its share of a core since it started, and its
    resident memory; nothing where the process is gone.
    """
    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        tick_hz = os.sysconf("SC_CLK_TCK")
        cpu_s = (int(fields[11]) + int(fields[12])) / tick_hz
        up_s = float(Path("/proc/uptime").read_text().split()[0])
        age_s = max(1 / tick_hz, up_s - int(fields[19]) / tick_hz)
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return {
            "cpu_s": cpu_s,
            "cpu_percent": round(100 * cpu_s / age_s, 1),
            "memory_mb": round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1),
        }
    return {}


def _text(node: dict[str, Any]) -> list[str]:
    restarts = f", restarted {node['restarts']} times" if node["restarts"] else ""
    lines = [
        node["name"],
        *_entry("type", node["type"]),
        *_entry("condition", node["condition"] + restarts),
        *_entry("process", f"{node['pid']} on {node['host']}"),
    ]
    if "cpu_s" in node:
        shares = f"{node['cpu_percent']:.1f} % of a core since it started"
        lines += _entry("uses", f"{shares}, {node['memory_mb']:.0f} MB of memory")
    if node["line"]:
        lines += _entry("says", node["line"])
    if node["refused"]:
        counts = ", ".join(f"{reason} {n}" for reason, n in node["refused"].items())
        lines += _entry("refused", f"{counts}; the last: {node['refusal']}")
    if node["inputs"]:
        rows = [
            [e["topic"], e["publisher"] or ELSEWHERE, *(e[what] for what in COUNTED)]
            for e in node["inputs"]
        ]
        lines += ["", *table(["INPUT", "FROM", *(what.upper() for what in COUNTED)], rows, "  ")]
    if node["outputs"]:
        rows = [[e["topic"], e["sent"], ", ".join(e["subscribers"])] for e in node["outputs"]]
        lines += ["", *table(["OUTPUT", "SENT", "READ BY"], rows, "  ")]
    if node["commands"]:
        lines += ["", *table(["COMMAND", "WHAT IT DOES"], list(node["commands"].items()), "  ")]
    preset = preset_of(node["settings"])
    rows = [
        [
            entry["key"],
            "live" if entry["live"] else "",
            shown_value(entry["value"]) + in_force_text(entry, preset),
        ]
        for entry in node["settings"]
    ]
    lines += ["", *table(["SETTING", "", "VALUE"], rows, "  ")]
    return lines


def _entry(key: str, text: str) -> list[str]:
    return wrapped(f"  {key:<10} ", printable(text))
