"""The commands `sparseskin launch`, a graph of nodes from a launch file until its streams end, and
`keys`, the key pairs of graphs that others could reach.
"""

import argparse
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from sparseskin.launch.attach.text import table
from sparseskin.launch.launchfile import bundled_names
from sparseskin.messages.text import printable

from .options import (
    add_commands,
    add_page,
    add_set,
    add_summary,
    check_summary,
    print_ends,
    rare,
    whole,
    write_summary,
)

if TYPE_CHECKING:
    from sparseskin.launch.launchfile.spec import LaunchFile
    from sparseskin.launch.run.run_log import RunLog

REPLAY = "replay"
"""The bundled launch file that a recording is replayed by."""
STATUS_LINE = (
    "The status line: frames, frames a second, frames lost; contacts or force; of contact frames, "
    "mean PSNR and share trusted by the solver; latency; PSNR of the taxels themselves."
)

NEXT = """
The live page:  {0} launch {1} --open
Other scenes:   {0} scenes
Your own file:  {0} launch F"""
"""What is printed in a terminal after a bundled launch file."""


def configure(parser: argparse.ArgumentParser) -> None:
    parser.description = "Start a graph of nodes, watch it, and print what the monitor measured."
    parser.epilog = f"Bundled launch files: {', '.join(bundled_names())}. {STATUS_LINE}"
    more = rare(parser)
    about = "launch file; or a recording, which is replayed as a skin"
    parser.add_argument("name", metavar="NAME|FILE", help=about)
    add_set(
        parser,
        "change one setting of one node, or with graph.KEY=VALUE of the graph",
        "NODE.KEY=VALUE",
    )
    parser.add_argument(
        "--frames",
        metavar="K",
        type=whole(1),
        help="end each source after K frames of the sensor; a player plays all messages of these",
    )
    about = "check the launch file (modules that it names are imported), print the graph"
    parser.add_argument("--dry-run", action="store_true", help=about)
    about = "run the part of this host, of a graph of several"
    more.add_argument("--host", metavar="NAME", help=about)
    parser.add_argument("--record", metavar="F.mcap", help="record all topics into a file")
    about = "open the live page in a browser; a scene or recording is shown again and again"
    add_page(parser, about)
    add_summary(parser)
    parser.set_defaults(run=_launch)


def _launch(arguments: argparse.Namespace) -> int:
    from sparseskin.launch.launchfile.load import load
    from sparseskin.nodes.monitor.node import Monitor

    source = _source_of(arguments.name)
    if source:
        arguments.name = REPLAY
        arguments.set = [f"sensor.source={source}", *arguments.set]
    launch = load(arguments.name, arguments.set, arguments.record)
    wanted = ["browser=true"] * arguments.open + ["token=false"] * arguments.no_token
    if wanted:
        nodes = launch.nodes.values()
        monitors = [node.name for node in nodes if issubclass(node.cls, Monitor)]
        changes = [f"{name}.{change}" for name in monitors for change in wanted]
        again = arguments.open and arguments.record is None
        loops = [f"{node.name}.loop=true" for node in nodes if again and _ends(node.settings)]
        launch = load(arguments.name, [*loops, *arguments.set, *changes], arguments.record)
    if arguments.dry_run:
        print(graph_text(launch))
        return 0
    return _run(launch.part(arguments.host), arguments)


def _source_of(name: str) -> str:
    """The source that a name states in place of a launch file, file:PATH, example:NAME or the path
    of a recording; "" if it is a launch file.
    """
    if name.partition(":")[0] in ("file", "example"):
        return name
    is_launch_file = name in bundled_names() or name.endswith(".toml")
    return f"file:{name}" if not is_launch_file and Path(name).exists() else ""


def graph_text(launch: "LaunchFile") -> str:
    """Nodes with their settings, then hosts, then topics with those that write and read them."""
    nodes = []
    for node in launch.nodes.values():
        stated = {
            "host": node.host,
            **{key: value for key, value in node.values.items() if key != "launch"},
            "cpus": list(node.scheduling.cpus),
            "priority": node.scheduling.priority,
            "process": node.process,
        }
        shown = [  # of the keys of all nodes those that are stated
            f"{key} = {value!r}" for key, value in stated.items() if value or key in node.values
        ]
        nodes.append([node.name, node.type_name, ", ".join(shown)])
    hosts = [
        [name, host.address, ", ".join(f"{n.name} at {n.public}" for n in here if n.public)]
        for name, host in launch.hosts.items()
        for here in ([n for n in launch.nodes.values() if n.host == name],)
    ]
    topics = [
        [topic, links[0].writer, ", ".join(link.reader for link in links)]
        for topic in dict.fromkeys(link.topic for link in launch.links)
        for links in ([link for link in launch.links if link.topic == topic],)
    ]
    lines = [f"{launch.name}: {launch.description}", f"transport {launch.transport}", ""]
    lines += table(["NODE", "TYPE", "SETTINGS"], nodes)
    lines += ["", *table(["HOST", "ADDRESS", "NODES"], hosts)] if hosts else []
    lines += ["", *table(["TOPIC (/PATCH/SCHEMA)", "PUBLISHER", "SUBSCRIBERS"], topics)]
    return "\n".join(map(printable, lines))


def _ends(settings: object) -> bool:
    """True of a sensor whose scene or recording has an end."""
    from sparseskin.nodes.sensor.settings import WITH_END, SensorSettings

    if not isinstance(settings, SensorSettings) or settings.patches:
        return False
    return settings.source.partition(":")[0] in WITH_END


def _run(launch: "LaunchFile", arguments: argparse.Namespace) -> int:
    from sparseskin.launch.run.fleet import EXIT_FAILED, EXIT_USAGE
    from sparseskin.launch.run.launcher import Launcher
    from sparseskin.launch.run.terminal import Terminal
    from sparseskin.nodes.monitor.table import summary_table

    check_summary(arguments.summary)
    run_log = _run_log(launch)
    launcher = Launcher(launch, Terminal(run_log), arguments.frames)
    code = launcher.run()
    if run_log is not None:
        run_log.close()
    summary = launcher.summary()
    sensed = {name: p for name, p in summary["patches"].items() if p["frames"]["sensed"]}
    patches = sensed or summary["patches"]  # none where the monitor is on another host
    try:
        if sensed or code != EXIT_USAGE:
            if patches:
                print(summary_table(patches))
            print_ends(summary["nodes"])
            sys.stdout.flush()
    finally:  # stdout may be on a full disk
        write_summary(arguments.summary, "launch-summary", summary)
    if run_log is not None and code in (EXIT_FAILED, EXIT_USAGE):
        print(f"logs of the nodes: {run_log.folder}", file=sys.stderr)
    if code == 0 and launch.name in bundled_names() and sys.stderr.isatty():
        program = "sparseskin" if shutil.which("sparseskin") else sys.argv[0]
        print(NEXT.format(program, launch.name), file=sys.stderr)
    for name, patch in sensed.items():
        if not patch["frames"]["reconstructed"]:
            print(f"{name}: not one frame was reconstructed", file=sys.stderr)
            code = code or 1
    return code


def _run_log(launch: "LaunchFile") -> "RunLog | None":
    """The log files of a run; None, with a warning, if the default folder cannot be made."""
    from sparseskin.launch.run.run_log import MAX_RUNS, RunLog
    from sparseskin.nodes.errors import SparseskinError
    from sparseskin.nodes.files import user_folder

    if launch.log_dir:
        return RunLog(Path(launch.log_dir), launch.name, time.time())
    try:
        return RunLog(user_folder("state") / "log", launch.name, time.time(), MAX_RUNS)
    except SparseskinError as error:
        reason = str(error).removeprefix("log_dir: ")
        print(f"warning: no log files: {reason}; graph.log_dir states another", file=sys.stderr)
        return None


KEY_FOLDER = "keys"


def configure_keys(parser: argparse.ArgumentParser) -> None:
    about = "Key pairs, one a host: its secret stays there, its public key goes to the others."
    make = add_commands(parser, about)("make", _make_keys, "make a key pair")
    make.add_argument("name", metavar="NAME", help="name of the key, as a rule that of the host")
    about = f"folder to write to (default: {KEY_FOLDER})"
    make.add_argument("--dir", metavar="D", type=Path, default=Path(KEY_FOLDER), help=about)


def _make_keys(arguments: argparse.Namespace) -> int:
    """Write NAME.key, the secret, which only you can read, and NAME.pub."""
    from sparseskin.nodes.network.keys import make_key_files

    secret, public = make_key_files(arguments.name, arguments.dir)
    print(f"{secret}: the secret key of {arguments.name}; it stays on that host")
    print(f"{public}: its public key; copy it to the folder of keys of each peer")
    return 0
