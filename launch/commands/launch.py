"""The command `sparseskin launch`: a graph of nodes from a launch file, until its streams end."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sparseskin.launch.launchfile.spec import LaunchFile
    from sparseskin.launch.run.run_log import RunLog

LAUNCH_FILES = Path(__file__).parent.parent
NO_TOKEN = "serve the live page to all users of this host, without a token"
PICTURES = {
    "dot": "write the graph as DOT text",
    "svg": "draw the graph (needs the program dot of Graphviz)",
    "png": "the same as a PNG",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `launch`."""
    bundled = sorted(path.stem for path in LAUNCH_FILES.glob("*.toml"))
    parser.description = "Start a graph of nodes, watch it, and print what the monitor measured."
    parser.epilog = f"Launch files that come with it: {', '.join(bundled)}."
    parser.add_argument("name", metavar="NAME|FILE.toml", help="launch file")
    parser.add_argument(
        "--set",
        metavar="NODE.KEY=VALUE",
        action="append",
        default=[],
        help="change one setting of one node (may be repeated)",
    )
    parser.add_argument(
        "--frames", metavar="K", type=_positive, help="end each source after K frames"
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="check the launch file, print the graph, start none"
    )
    parser.add_argument(
        "--host", metavar="NAME", help="run the part of this host, of a graph of several"
    )
    for form, about in PICTURES.items():
        parser.add_argument(
            f"--{form}", metavar=f"F.{form}", type=Path, help=f"with --dry-run: {about}"
        )
    parser.add_argument("--record", metavar="F.mcap", help="record all topics into a file")
    parser.add_argument("--open", action="store_true", help="open the live page in a browser")
    parser.add_argument("--no-token", action="store_true", help=NO_TOKEN)
    parser.add_argument("--summary", metavar="OUT.json", help="write the summary to a file")
    parser.add_argument(
        "--log-dir",
        metavar="DIR",
        help="folder in which each run has a folder of its own, with a log file a node "
        "(default: the launch file's log_dir, or sparseskin/log in $XDG_STATE_HOME)",
    )
    parser.set_defaults(run=_launch)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number, 1 or more")
    return int(text)


def _launch(arguments: argparse.Namespace) -> int:
    from sparseskin.launch.launchfile.load import load
    from sparseskin.launch.launchfile.spec import LaunchError
    from sparseskin.nodes.monitor.node import Monitor

    launch = load(arguments.name, arguments.set, arguments.record)
    wanted = ["browser=true"] * arguments.open + ["token=false"] * arguments.no_token
    if wanted:
        monitors = [node.name for node in launch.nodes.values() if issubclass(node.cls, Monitor)]
        changes = [f"{name}.{change}" for name in monitors for change in wanted]
        launch = load(arguments.name, [*arguments.set, *changes], arguments.record)
    pictures = {form: getattr(arguments, form) for form in PICTURES if getattr(arguments, form)}
    if arguments.dry_run:
        from sparseskin.launch.launchfile.graph_text import graph_text, write_graph

        for form, path in pictures.items():
            write_graph(launch, form, path)
        print(graph_text(launch))
        return 0
    if pictures:
        raise LaunchError(["--dot, --svg, --png: only with --dry-run"])
    return _run(launch.part(arguments.host), arguments)


def _run(launch: LaunchFile, arguments: argparse.Namespace) -> int:
    from sparseskin.launch.run.launcher import EXIT_FAILED, EXIT_USAGE, Launcher
    from sparseskin.launch.run.terminal import Terminal
    from sparseskin.nodes.files import check_writable
    from sparseskin.nodes.monitor.table import summary_table

    if arguments.summary is not None:
        check_writable(Path(arguments.summary))
    run_log = _run_log(launch, arguments.log_dir)
    launcher = Launcher(launch, Terminal(run_log), arguments.frames)
    code = launcher.run()
    if run_log is not None:
        run_log.close()
        if code in (EXIT_FAILED, EXIT_USAGE):
            print(f"logs of the nodes: {run_log.folder}", file=sys.stderr)
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
    """The log files of a run; None if none were asked for and the default folder cannot be made."""
    from sparseskin.launch.launchfile.spec import LaunchError
    from sparseskin.launch.run.run_log import RunLog, default_log_dir

    wanted = stated or launch.log_dir
    if wanted:
        return RunLog(Path(wanted), launch.name, time.time())
    try:
        return RunLog(default_log_dir(), launch.name, time.time())
    except LaunchError:
        return None


def _write_summary(path: Path, summary: dict[str, Any]) -> None:
    from importlib.metadata import version

    from sparseskin.nodes.errors import SettingsError

    text = json.dumps({"sparseskin": version("sparseskin"), **summary}, indent=2)
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise SettingsError(f"--summary {path}: {error.strerror}") from error
