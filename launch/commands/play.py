"""The command `sparseskin play`: publishes a recording, and shows it on a live page."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.nodes.errors import SettingsError

from .options import add_page, naming_options, print_ends, real, whole
from .scenes import SCENARIOS, resolve_recording

if TYPE_CHECKING:
    from sparseskin.launch.launchfile.spec import LaunchFile

PLAY_KEYS = {
    " ": ("player", "pause"),
    "right": ("player", "step"),
    "up": ("player", "faster"),
    "down": ("player", "slower"),
}
STEP_KEYS = PLAY_KEYS | {" ": ("player", "step"), "\n": ("player", "step")}
PLAY_OPTIONS = {
    "rate": "--rate",
    "start_s": "--start",
    "duration_s": "--duration",
    "topics": "--topics",
    "remap": "--remap",
    "wait": "--wait",
}
"""Settings of the player, and the options that state them."""


def configure_play(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `play`."""
    parser.description = (
        "Publish what was recorded, as it was recorded. Keys: space pauses, right plays one frame, "
        "up and down change the rate, q ends."
    )
    about = f"recording, or an address of one; or {', '.join(SCENARIOS)}"
    parser.add_argument("file", metavar="F.mcap|NAME", help=about)
    about = "times the recorded speed; 0: as fast as it is read"
    parser.add_argument("--rate", type=real(False), default=1.0, metavar="R", help=about)
    parser.add_argument("--loop", action="store_true", help="start again at the end")
    parser.add_argument(
        "--start", type=real(False), default=0.0, metavar="S", help="seconds to skip"
    )
    parser.add_argument("--duration", type=real(False), metavar="S", help="seconds to play")
    parser.add_argument("--pause", action="store_true", help="start paused")
    parser.add_argument("--step", action="store_true", help="play one frame a key")
    parser.add_argument("--topics", nargs="+", default=[], metavar="T", help="topics to play")
    about = "other names for topics or patches"
    parser.add_argument("--remap", nargs="+", default=[], metavar="A:=B", help=about)
    about = "send no frame before all readers have handled the last"
    parser.add_argument("--lockstep", action="store_true", help=about)
    parser.add_argument(
        "--wait", type=whole(0), default=0, metavar="K", help="wait for K readers first"
    )
    add_page(parser, "open a live page that shows it, again and again")
    parser.set_defaults(run=_play)


def _play(arguments: argparse.Namespace) -> int:
    """Run a player as a graph of its own, which others may join; with a page, a monitor too."""
    from sparseskin.launch.run.launcher import Launcher
    from sparseskin.launch.run.terminal import Terminal

    if arguments.no_token and not arguments.open:
        raise SettingsError("--no-token: goes with --open: without it there is no page")
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
    with naming_options(PLAY_OPTIONS):
        launch = _with_page(arguments, path, values) if arguments.open else _alone(path, values)
    keys = STEP_KEYS if arguments.step else PLAY_KEYS
    launcher = Launcher(launch, Terminal(), keys=keys)
    code = launcher.run()
    print_ends(launcher.summary()["nodes"])
    return code


def _alone(path: Path, values: dict[str, Any]) -> LaunchFile:
    from sparseskin.launch.launchfile.load import single_node

    return replace(single_node("player", "player", values), name=path.stem)


def _with_page(arguments: argparse.Namespace, path: Path, values: dict[str, Any]) -> LaunchFile:
    """A player, what has to be computed anew, and a monitor with its page.

    Raises SettingsError if the recording has too little to be shown.
    """
    from sparseskin.launch.launchfile.load import load_tables

    for option in ("topics", "remap"):
        if getattr(arguments, option):
            raise SettingsError(f"--{option}: does not go with --open, which plays what it shows")
    by_patch = schemas_of(path)
    schemas, made = shown(path, by_patch)
    # Of frames that are played now: their stamps, and so their ages, are those of now.
    values |= {"loop": True, "verbatim": False, "schemas": schemas}
    values = {key: value for key, value in values.items() if key not in ("topics", "remap")}
    patches = list(by_patch)
    tables: dict[str, dict[str, Any]] = {"player": {"type": "player", **values}}
    for patch in patches:
        ending = f"_{patch}" if len(patches) > 1 else ""
        for kind in made:
            tables[f"{kind}{ending}"] = {"type": kind, "patch": patch}
    page = {"browser": True, "token": not arguments.no_token}
    tables["monitor"] = {"type": "monitor", "patches": patches, **page}
    return load_tables(path.stem, tables)


def shown(path: Path, by_patch: dict[str, set[str]]) -> tuple[list[str], list[str]]:
    """Schemas to play of a recording, and types of the nodes that compute the rest of what a
    monitor shows; `by_patch` are those that it has.

    Raises SettingsError if the recording has too little for that.
    """
    present = set.intersection(*by_patch.values()) if by_patch else set()
    optional = [s for s in ("taxels", "truth", "resultant") if s in present]
    if present >= {"skin", "phi", "measurements"}:
        known = ["skin", "phi", "measurements"]
        if present >= {"solver", "reconstruction"}:
            return [*known, "solver", "reconstruction", *optional], []
        optional = [schema for schema in optional if schema != "resultant"]
        return [*known, *optional], ["reconstructor"]
    if present >= {"skin", "taxels"}:
        optional = [schema for schema in optional if schema == "truth"]
        return ["skin", "taxels", *optional], ["compressor", "reconstructor"]
    raise SettingsError(
        f"{path}: --open: has neither taxels nor measurements with their skin and Phi; "
        "record all topics"
    )


def schemas_of(path: Path) -> dict[str, set[str]]:
    """Schemas of which a recording has messages, by patch.
    Raises BagError if it cannot be read.
    """
    from sparseskin.messages.topics import split_topic
    from sparseskin.nodes.recorder.bag.reader import BagReader

    found: dict[str, set[str]] = {}
    with BagReader(path) as bag:
        for topic, info in bag.topics.items():
            if info.n_messages:
                patch, schema = split_topic(topic)
                found.setdefault(patch, set()).add(schema)
    return found
