"""The commands `sparseskin record` and `sparseskin play`."""

from __future__ import annotations

import argparse
import fnmatch
import os
import sys
import time
from dataclasses import replace
from typing import Any

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.graph import Link
from sparseskin.nodes.lookup import did_you_mean

from .launcher import Launcher
from .launchfile import single_node
from .running import choose_graph
from .scenes_command import SCENARIOS, resolve_recording
from .terminal import Terminal

PLAY_KEYS = {
    " ": ("player", "pause"),
    "right": ("player", "step"),
    "up": ("player", "faster"),
    "down": ("player", "slower"),
}
STEP_KEYS = PLAY_KEYS | {" ": ("player", "step"), "\n": ("player", "step")}


def add_record_parser(commands: Any) -> None:
    """Add `record` to the commands."""
    parser = commands.add_parser(
        "record",
        help="record topics of a running graph",
        description="Record topics of a running graph into an MCAP file, until it ends or Ctrl-C.",
    )
    parser.add_argument(
        "topics", metavar="TOPIC", nargs="*", help="topics, all by default; * fits any text"
    )
    parser.add_argument("--out", metavar="F.mcap", help="file to write; named by graph and time")
    parser.add_argument("--graph", metavar="NAME", help="which graph, where several run")
    parser.set_defaults(run=record)


def record(arguments: argparse.Namespace) -> int:
    """Run a recorder beside a running graph."""
    graph = choose_graph(arguments.graph)
    writers = graph.writers()
    patterns = arguments.topics or ["*"]
    for pattern in patterns:
        if not fnmatch.filter(writers, pattern):
            hint = did_you_mean(pattern, writers)
            raise SettingsError(f"{pattern}: {graph.label} has no such topic{hint}")
    topics = [t for t in writers if any(fnmatch.fnmatchcase(t, p) for p in patterns)]
    out = arguments.out or f"{graph.name}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
    name = f"record_{os.getpid()}"
    values = {"out": out, "topics": topics, "launch": graph.launch, "source": graph.name}
    launch = single_node(name, "recorder", values)
    links = [Link(topic, writers[topic], name) for topic in topics]
    launcher = Launcher(replace(launch, links=links), Terminal(), joined=graph)
    code = launcher.run()
    found = launcher.summary()["nodes"][name]
    recording = found.get("recording", {})
    lost = sum(found.get("lost", {}).values())
    if recording and not recording["error"]:
        print(f"{out}: {recording['n_messages']} messages recorded, {lost} dropped")
    elif not recording and code > 128:
        print(f"{out}: nothing was recorded: the recorder had not started yet", file=sys.stderr)
    return code


def add_play_parser(commands: Any) -> None:
    """Add `play` to the commands."""
    parser = commands.add_parser(
        "play",
        help="play a recording",
        description="Publish what was recorded, as it was recorded. Keys: space pauses, right "
        "plays one frame, up and down change the rate, q ends.",
    )
    parser.add_argument("file", metavar="F.mcap|NAME", help=f"recording; or {', '.join(SCENARIOS)}")
    parser.add_argument(
        "--rate",
        type=float,
        default=1.0,
        metavar="R",
        help="times the recorded speed; 0: as fast as it is read",
    )
    parser.add_argument("--loop", action="store_true", help="begin again at the end")
    parser.add_argument(
        "--start", type=float, default=0.0, metavar="S", help="seconds to leave out"
    )
    parser.add_argument("--duration", type=float, metavar="S", help="seconds to play")
    parser.add_argument("--pause", action="store_true", help="begin with a pause")
    parser.add_argument("--step", action="store_true", help="play one frame a key")
    parser.add_argument("--topics", nargs="+", default=[], metavar="T", help="topics to play")
    parser.add_argument(
        "--remap", nargs="+", default=[], metavar="A:=B", help="other names for topics or patches"
    )
    parser.add_argument(
        "--lockstep",
        action="store_true",
        help="send no frame before all readers are done with the last",
    )
    parser.add_argument("--wait", type=int, default=0, metavar="K", help="wait for K readers first")
    parser.set_defaults(run=play)


def play(arguments: argparse.Namespace) -> int:
    """Run a player as a graph of its own, which others may join."""
    path = resolve_recording(arguments.file)
    values: dict[str, Any] = {
        "file": str(path),
        "rate": arguments.rate,
        "loop": arguments.loop,
        "start_s": arguments.start,
        "paused": arguments.pause or arguments.step,
        "topics": arguments.topics,
        "remap": arguments.remap,
        "lockstep": arguments.lockstep,
        "wait": arguments.wait,
        "verbatim": not (arguments.loop or arguments.remap),
    }
    if arguments.duration is not None:
        values["duration_s"] = arguments.duration
    launch = replace(single_node("player", "player", values), name=path.stem)
    keys = STEP_KEYS if arguments.step else PLAY_KEYS
    return Launcher(launch, Terminal(), keys=keys).run()
