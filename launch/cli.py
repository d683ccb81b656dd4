"""The command `sparseskin`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.monitor.node import Monitor
from sparseskin.nodes.monitor.table import summary_table

from .bag_commands import add_bag_parser
from .completion import add_completion_parser
from .graph_drawing import write_png, write_svg
from .keys_command import add_keys_parser
from .launcher import EXIT_FAILED, Launcher
from .launchfile import LaunchError, LaunchFile, bundled_names, load
from .learn_basis import add_learn_basis_parser
from .monitor_command import add_monitor_parser
from .node_commands import add_node_parser
from .param_commands import add_param_parser
from .parts import part_of
from .recording_commands import add_play_parser, add_record_parser
from .reprocess import add_reprocess_parser
from .run_log import RunLog, default_log_dir
from .scenes_command import add_scenes_parser
from .terminal import Terminal
from .topic_commands import add_topic_parser
from .whole_file import check_writable

EXIT_USAGE = 2
#: By name, as node types are: studies use this package, not this package studies.
STUDIES = "sparseskin.studies.command"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    arguments = _parser().parse_args(argv)
    try:
        return int(arguments.run(arguments))
    except LaunchError as error:
        for line in error.lines:
            print(line, file=sys.stderr)
    except SparseskinError as error:
        print(error, file=sys.stderr)
    return EXIT_USAGE


class _Parser(argparse.ArgumentParser):
    """One whose refusal is one line, as all others of the command are; so are its subparsers'."""

    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_USAGE, f"{self.prog}: {message} (see {self.prog} --help)\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="sparseskin", description="Compressed sensing for robot tactile skins.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {version('sparseskin')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    launch = commands.add_parser(
        "launch",
        help="start a graph of nodes from a launch file",
        description="Start a graph of nodes, watch it, and print what the monitor found.",
        epilog=f"Launch files that come with it: {', '.join(bundled_names())}.",
    )
    launch.add_argument("name", metavar="NAME|FILE.toml", help="launch file")
    launch.add_argument(
        "--set",
        metavar="NODE.KEY=VALUE",
        action="append",
        default=[],
        help="change one setting of one node (may be repeated)",
    )
    launch.add_argument(
        "--frames", metavar="K", type=_positive, help="end each source after K frames"
    )
    launch.add_argument(
        "--dry-run", action="store_true", help="check the launch file, print the graph, start none"
    )
    launch.add_argument(
        "--host", metavar="NAME", help="run the part of this host, of a graph of several"
    )
    launch.add_argument(
        "--svg", metavar="F.svg", type=Path, help="with --dry-run: draw the graph into a file"
    )
    launch.add_argument(
        "--png", metavar="F.png", type=Path, help="the same as a PNG (needs matplotlib)"
    )
    launch.add_argument("--record", metavar="F.mcap", help="record all topics into a file")
    launch.add_argument("--open", action="store_true", help="open the live page in a browser")
    launch.add_argument("--summary", metavar="OUT.json", help="write the summary to a file")
    launch.add_argument(
        "--log-dir",
        metavar="DIR",
        help="folder in which each run has a folder of its own, with a log file a node "
        f"(default: the launch file's log_dir, or {default_log_dir()})",
    )
    launch.set_defaults(run=_launch)
    add_keys_parser(commands)
    add_monitor_parser(commands)
    add_node_parser(commands)
    add_param_parser(commands)
    add_topic_parser(commands)
    add_record_parser(commands)
    add_play_parser(commands)
    add_bag_parser(commands)
    add_reprocess_parser(commands)
    add_learn_basis_parser(commands)
    add_scenes_parser(commands)
    studies = import_module(STUDIES)
    studies.add_study_parser(commands)
    add_completion_parser(commands, parser, {"STUDY": studies.STUDIES})
    return parser


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number, 1 or more")
    return int(text)


def _launch(arguments: argparse.Namespace) -> int:
    launch = load(arguments.name, arguments.set, arguments.record)
    if arguments.open:
        monitors = [node.name for node in launch.nodes.values() if issubclass(node.cls, Monitor)]
        changes = [f"{name}.browser=true" for name in monitors]
        launch = load(arguments.name, [*arguments.set, *changes], arguments.record)
    if arguments.dry_run:
        if arguments.svg is not None:
            write_svg(launch, arguments.svg)
        if arguments.png is not None:
            write_png(launch, arguments.png)
        print(graph_text(launch))
        return 0
    if arguments.svg is not None or arguments.png is not None:
        raise LaunchError(["--svg, --png: only with --dry-run"])
    launch = part_of(launch, arguments.host)
    if arguments.summary is not None:
        check_writable(Path(arguments.summary))
    run_log = _run_log(launch, arguments.log_dir)
    launcher = Launcher(launch, Terminal(run_log), arguments.frames)
    code = launcher.run()
    if run_log is not None:
        run_log.close()
        if code in (EXIT_FAILED, EXIT_USAGE):
            print(f"what the nodes said: {run_log.folder}", file=sys.stderr)
    summary = launcher.summary()
    sensed = {name: p for name, p in summary["patches"].items() if p["frames"]["sensed"]}
    patches = sensed or summary["patches"]  # none where the monitor is on another host
    if patches and (sensed or code != EXIT_USAGE):
        print(summary_table(patches))
    for name, patch in sensed.items():
        if not patch["frames"]["reconstructed"]:
            print(f"{name}: not one frame was reconstructed", file=sys.stderr)
            code = code or 1
    if arguments.summary is not None:
        _write_summary(Path(arguments.summary), summary)
    return code


def _run_log(launch: LaunchFile, stated: str | None) -> RunLog | None:
    """Where the logs go; nowhere, if not even the default folder can be made."""
    wanted = stated or launch.log_dir
    if wanted:
        return RunLog(Path(wanted), launch.name, time.time())
    try:
        return RunLog(default_log_dir(), launch.name, time.time())
    except LaunchError:
        return None  # nobody has asked for it


def graph_text(launch: LaunchFile) -> str:
    """The graph of a launch file as text: its nodes with their settings, then its links."""
    lines = [f"{launch.name}: {launch.description}", f"transport {launch.transport}", "", "nodes"]
    name_width = max(len(node.name) for node in launch.nodes.values())
    type_width = max(len(node.type_name) for node in launch.nodes.values())
    for node in launch.nodes.values():
        shown = {k: v for k, v in node.values.items() if k != "launch"}
        if node.host:
            shown = {"host": node.host, **shown}
        settings = ", ".join(f"{key} = {value!r}" for key, value in shown.items())
        lines.append(
            f"  {node.name:<{name_width}} {node.type_name:<{type_width}} {settings}".rstrip()
        )
    for host in launch.hosts.values():
        told = [f"{n.name} at {n.public}" for n in launch.nodes.values() if n.host == host.name]
        lines += ["", f"host {host.name}", f"  {host.address}"]
        lines += [f"  {line}" for line in told if not line.endswith(" at ")]
    lines += ["", "links"]
    width = max((len(link.writer) + len(link.topic) for link in launch.links), default=0) + 9
    for link in launch.links:
        lines.append(f"  {f'{link.writer} -- {link.topic} ':-<{width}}> {link.reader}")
    return "\n".join(lines)


def _write_summary(path: Path, summary: dict[str, Any]) -> None:
    text = json.dumps({"sparseskin": version("sparseskin"), **summary}, indent=2)
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise LaunchError([f"--summary {path}: {error.strerror}"]) from error
