"""The commands `sparseskin launch`, a graph of nodes from a launch file until its streams end, and
`keys`, the key pairs of graphs that others could reach.
"""

import argparse
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    from sparseskin.launch.launchfile.spec import LaunchFile, NodeSpec
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
    parser.description = (
        "Start a graph of nodes, watch it, and print what the monitor measured."
    )
    parser.epilog = f"Bundled launch files: {', '.join(bundled_names())}. {STATUS_LINE}"
    parser.add_argument(
        "name",
        metavar="NAME|FILE",
        help="launch file; or a recording, which is replayed as a skin",
    )
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
    about = (
        "check the launch file (modules that it names are imported), print the graph"
    )
    parser.add_argument("--dry-run", action="store_true", help=about)
    rare(parser).add_argument(
        "--host",
        metavar="NAME",
        help="run the part of this host, of a graph of several",
    )
    parser.add_argument(
        "--record", metavar="F.mcap", help="record all topics into a file"
    )
    about = (
        "open the live page in a browser; a scene or recording is shown again and again"
    )
    add_page(parser, about)
    add_summary(parser)
    parser.set_defaults(run=_launch)


def _launch(arguments: argparse.Namespace) -> int:
    from sparseskin.launch.launchfile.load import load

    # A recording in place of a launch file is replayed as a skin.
    source = _source_of(arguments.name)
    if source:
        arguments.name = REPLAY
        arguments.set = [f"sensor.source={source}", *arguments.set]
    # Loaded once without the page: which node is a monitor is known then.
    launch = load(arguments.name, arguments.set, arguments.record)
    if arguments.open or arguments.no_token:
        settings = _with_page(launch, arguments)
        launch = load(arguments.name, settings, arguments.record)

    if arguments.dry_run:
        print(graph_text(launch))
        return 0
    return _run(launch.part(arguments.host), arguments)


def _with_page(launch: "LaunchFile", arguments: argparse.Namespace) -> list[str]:
    """The settings of a command line with those that its options of the page stand for."""
    from sparseskin.nodes.monitor.node import Monitor

    loops = []
    changes = []
    for node in launch.nodes.values():
        # A recording has its end.
        if arguments.open and arguments.record is None and _ends(node.settings):
            loops.append(f"{node.name}.loop=true")
        if issubclass(node.cls, Monitor) and arguments.open:
            changes.append(f"{node.name}.browser=true")
        if issubclass(node.cls, Monitor) and arguments.no_token:
            changes.append(f"{node.name}.token=false")
    return [*loops, *arguments.set, *changes]


def _source_of(name: str) -> str:
    """The source that a name states in place of a launch file, file:PATH, example:NAME or the path
    of a recording; "" if it is a launch file.
    """
    if name.partition(":")[0] in ("file", "example"):
        return name
    # A name that is neither is reported as an unknown launch file.
    is_launch_file = name in bundled_names() or name.endswith(".toml")
    if is_launch_file or not Path(name).exists():
        return ""
    return f"file:{name}"


def graph_text(launch: "LaunchFile") -> str:
    """Nodes with their settings, then hosts, then topics with those that write and read them."""
    nodes = []
    for node in launch.nodes.values():
        nodes.append([node.name, node.type_name, _settings_text(node)])

    hosts = []
    for name, host in launch.hosts.items():
        # A node is public where another host reads it.
        at_host = [node for node in launch.nodes.values() if node.host == name]
        public = [f"{node.name} at {node.public}" for node in at_host if node.public]
        hosts.append([name, host.address, ", ".join(public)])

    writers: dict[str, str] = {}
    readers: dict[str, list[str]] = {}
    for link in launch.links:
        writers.setdefault(link.topic, link.writer)
        readers.setdefault(link.topic, []).append(link.reader)
    topics = []
    for topic, writer in writers.items():
        topics.append([topic, writer, ", ".join(readers[topic])])

    lines = [
        f"{launch.name}: {launch.description}",
        f"transport {launch.transport}",
        "",
    ]
    lines += table(["NODE", "TYPE", "SETTINGS"], nodes)
    if hosts:
        lines += ["", *table(["HOST", "ADDRESS", "NODES"], hosts)]
    lines += ["", *table(["TOPIC (/PATCH/SCHEMA)", "PUBLISHER", "SUBSCRIBERS"], topics)]
    return "\n".join(map(printable, lines))


def _settings_text(node: "NodeSpec") -> str:
    """Settings of a node; of the keys of all nodes those that are stated."""
    values: dict[str, Any] = {"host": node.host}
    # The text of the launch file is itself a value of the recorder.
    values |= {key: value for key, value in node.values.items() if key != "launch"}
    values["cpus"] = list(node.scheduling.cpus)
    values["priority"] = node.scheduling.priority
    values["process"] = node.process

    stated = []
    for key, value in values.items():
        if value or key in node.values:
            stated.append(f"{key} = {value!r}")
    return ", ".join(stated)


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

    # Before the run: it may take hours.
    check_summary(arguments.summary)
    run_log = _run_log(launch)
    launcher = Launcher(launch, Terminal(run_log), arguments.frames)
    code = launcher.run()
    if run_log is not None:
        run_log.close()

    summary = launcher.summary()
    # None where the monitor is on another host.
    patches = summary["patches"]
    # A patch of which no frame came has nothing to show beside others.
    sensed = {
        name: patch for name, patch in patches.items() if patch["frames"]["sensed"]
    }
    try:
        if sensed or code != EXIT_USAGE:
            _print_summary(launch.name, sensed or patches, summary["nodes"])
    finally:
        # Stdout may be on a full disk.
        write_summary(arguments.summary, "launch-summary", summary)

    if run_log is not None and code in (EXIT_FAILED, EXIT_USAGE):
        print(f"logs of the nodes: {run_log.folder}", file=sys.stderr)
    if code == 0 and launch.name in bundled_names() and sys.stderr.isatty():
        # As it was started here: it may not be on the path.
        program = sys.argv[0]
        if shutil.which("sparseskin"):
            program = "sparseskin"
        print(NEXT.format(program, launch.name), file=sys.stderr)
    for name, patch in sensed.items():
        # A graph whose frames are all lost has not done its work.
        if not patch["frames"]["reconstructed"]:
            print(f"{name}: not one frame was reconstructed", file=sys.stderr)
            code = code or 1
    return code


def _print_summary(graph: str, patches: dict[str, Any], nodes: dict[str, Any]) -> None:
    from sparseskin.nodes.monitor.table import summary_table

    if patches:
        print(summary_table(graph, patches))
    print_ends(nodes)
    sys.stdout.flush()


def _run_log(launch: "LaunchFile") -> "RunLog | None":
    """The log files of a run; None, with a warning, if the default folder cannot be made."""
    from sparseskin.launch.run.run_log import MAX_RUNS, RunLog
    from sparseskin.nodes.errors import SparseskinError
    from sparseskin.nodes.files import state_folder

    # A folder that is stated must be usable; the default one need not be.
    if launch.log_dir:
        return RunLog(Path(launch.log_dir), launch.name, time.time())
    try:
        return RunLog(state_folder() / "log", launch.name, time.time(), MAX_RUNS)
    except SparseskinError as error:
        reason = str(error).removeprefix("log_dir: ")
        print(
            f"warning: no log files: {reason}; graph.log_dir states another",
            file=sys.stderr,
        )
        return None


KEY_FOLDER = "keys"


def configure_keys(parser: argparse.ArgumentParser) -> None:
    about = "Key pairs, one a host: its secret stays there, its public key goes to the others."
    make = add_commands(parser, about)("make", _make_keys, "make a key pair")
    make.add_argument(
        "name", metavar="NAME", help="name of the key, as a rule that of the host"
    )
    make.add_argument(
        "--dir",
        metavar="D",
        type=Path,
        default=Path(KEY_FOLDER),
        help=f"folder to write to (default: {KEY_FOLDER})",
    )


def _make_keys(arguments: argparse.Namespace) -> int:
    """Write NAME.key, the secret, which only you can read, and NAME.pub."""
    from sparseskin.nodes.network.keys import make_key_files

    secret, public = make_key_files(arguments.name, arguments.dir)
    print(f"{secret}: the secret key of {arguments.name}; it stays on that host")
    print(f"{public}: its public key; copy it to the folder of keys of each peer")
    return 0
