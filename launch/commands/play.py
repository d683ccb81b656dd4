"""The commands `sparseskin play`, which publishes a recording and shows it on a live page, and
`scenes`, which lists and makes short recordings.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.launch.attach.text import size_text, table
from sparseskin.launch.offline.scenarios import (
    FILE_SUFFIX,
    PERIOD_NS,
    SCENARIOS,
    data_folder,
    make_scenario,
    resolve_recording,
    unknown_scenario,
)
from sparseskin.nodes.errors import SettingsError

from .options import add_commands, add_page, naming_options, print_ends, real, whole

if TYPE_CHECKING:
    from sparseskin.launch.launchfile.spec import LaunchFile
    from sparseskin.nodes.sensor.scenes.simulation import Scene

PLAY_KEYS = {
    " ": ("player", "pause"),
    "right": ("player", "step"),
    "up": ("player", "faster"),
    "down": ("player", "slower"),
}
STEP_KEYS = PLAY_KEYS | {" ": ("player", "step"), "\n": ("player", "step")}
OPTIONS = {
    key: f"--{key.removesuffix('_s')}"
    for key in ("rate", "loop", "start_s", "duration_s", "topics", "remap", "lockstep", "wait")
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
    parser.add_argument("--rate", type=real(False), metavar="R", help=about)
    parser.add_argument("--loop", action="store_true", default=None, help="start again at the end")
    seconds: dict[str, Any] = {"type": real(False), "metavar": "S"}
    parser.add_argument("--start", dest="start_s", help="seconds to skip", **seconds)
    parser.add_argument("--duration", dest="duration_s", help="seconds to play", **seconds)
    parser.add_argument("--topics", nargs="+", metavar="T", help="topics to play")
    about = "other names for topics or patches"
    parser.add_argument("--remap", nargs="+", metavar="A:=B", help=about)
    about = "send no frame before all readers have handled the last"
    parser.add_argument("--lockstep", action="store_true", default=None, help=about)
    parser.add_argument("--wait", type=whole(0), metavar="K", help="wait for K readers first")
    parser.add_argument("--pause", action="store_true", help="start paused")
    parser.add_argument("--step", action="store_true", help="play one frame a key")
    add_page(parser, "open a live page that shows it, again and again")
    parser.set_defaults(run=_play)


def _play(arguments: argparse.Namespace) -> int:
    """Run a player as a graph of its own, which others may join; with a page, a monitor too."""
    from sparseskin.launch.launchfile.load import single_node
    from sparseskin.launch.run.launcher import Launcher
    from sparseskin.launch.run.terminal import Terminal

    if arguments.no_token and not arguments.open:
        raise SettingsError("--no-token: goes with --open: without it there is no page")
    path = resolve_recording(arguments.file)
    stated = {key: getattr(arguments, key) for key in OPTIONS}
    values: dict[str, Any] = {
        **{key: value for key, value in stated.items() if value is not None},
        "file": str(path),
        "paused": arguments.pause or arguments.step,
        "verbatim": not (arguments.loop or arguments.remap),
    }
    with naming_options(OPTIONS):
        if arguments.open:
            launch = _with_page(arguments, path, values)
        else:
            launch = replace(single_node("player", "player", values), name=path.stem)
    keys = STEP_KEYS if arguments.step else PLAY_KEYS
    launcher = Launcher(launch, Terminal(), keys=keys)
    code = launcher.run()
    print_ends(launcher.summary()["nodes"])
    return code


def _with_page(arguments: argparse.Namespace, path: Path, values: dict[str, Any]) -> LaunchFile:
    """A player, what has to be computed anew, and a monitor with its page.

    Raises SettingsError if the recording has too little to be shown.
    """
    from sparseskin.launch.launchfile.load import load_tables
    from sparseskin.messages.topics import split_topic
    from sparseskin.nodes.recorder.bag.patches import names_of
    from sparseskin.nodes.recorder.bag.reader import BagReader

    for option in ("topics", "remap"):
        if getattr(arguments, option):
            raise SettingsError(f"--{option}: does not go with --open, which plays what it shows")
    by_patch: dict[str, set[str]] = {}
    with BagReader(path) as bag:
        batches = names_of(bag)
        for topic, info in bag.topics.items():
            if info.n_messages:
                patch, schema = split_topic(topic)
                by_patch.setdefault(patch, set()).add(schema)
    schemas, made = shown(path, by_patch)
    # Of frames that are played now: their stamps, and so their ages, are those of now.
    values |= {"loop": True, "verbatim": False, "schemas": schemas}
    values = {key: value for key, value in values.items() if key not in ("topics", "remap")}
    patches = list(by_patch)
    tables: dict[str, dict[str, Any]] = {"player": {"type": "player", **values}}
    for patch in patches:
        ending = f"_{patch}" if len(patches) > 1 else ""
        for kind in made:
            names = list(batches.get(patch, ()))
            tables[f"{kind}{ending}"] = {"type": kind, "patch": patch, "patches": names}
    watched = {"patches": [patch for patch in patches if patch not in batches], "batches": batches}
    page = {"browser": True, "token": not arguments.no_token}
    tables["monitor"] = {"type": "monitor", **watched, **page}
    return load_tables(path.stem, tables)


def shown(path: Path, by_patch: dict[str, set[str]]) -> tuple[list[str], list[str]]:
    """Schemas to play of a recording, and types of the nodes that compute the rest of what a
    monitor shows; `by_patch` are those that it has.

    Raises SettingsError if the recording has too little for that.
    """
    present = set.intersection(*by_patch.values()) if by_patch else set()
    optional = [s for s in ("taxels", "truth", "resultant", "contacts") if s in present]
    if present >= {"skin", "phi", "measurements"}:
        known = ["skin", "phi", "measurements"]
        if present >= {"solver", "reconstruction"}:
            return [*known, "solver", "reconstruction", *optional], []
        optional = [schema for schema in optional if schema in ("taxels", "truth")]
        return [*known, *optional], ["reconstructor"]
    if present >= {"skin", "taxels"}:
        optional = [schema for schema in optional if schema == "truth"]
        return ["skin", "taxels", *optional], ["compressor", "reconstructor"]
    raise SettingsError(
        f"{path}: --open: has neither taxels nor measurements with their skin and Phi; "
        "record all topics"
    )


_DATA_FOLDER = "$XDG_DATA_HOME/sparseskin or ~/.local/share/sparseskin"


def configure_scenes(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `scenes`."""
    about = "The scenes that can be launched, and short recordings that can be played."
    add = add_commands(parser, about)
    add("list", _list, "list scenes and recordings, one line each")
    make = add("make", _make, "make short recordings of scenes")
    make.description = f"{make.description} Scenes: {', '.join(SCENARIOS)}."
    make.add_argument("names", metavar="NAME", nargs="*", help="which; all by default")
    make.add_argument(
        "--out", metavar="DIR", type=Path, help=f"folder to write to (default: {_DATA_FOLDER})"
    )


def _list(arguments: argparse.Namespace) -> int:
    """List scenes and recordings, one line each."""
    from sparseskin.nodes.sensor.scenes.scenes import SCENES
    from sparseskin.nodes.sensor.source import about

    def row(name: str, scene: Scene, n_frames: int, period_ns: int, words: str) -> list[object]:
        return [name, "{} x {}".format(*scene.shape), n_frames, period_ns / 1e6, words]

    scenes = {name: make() for name, make in SCENES.items()}
    for title, rows in {
        "scenes: sparseskin launch NAME": [
            row(name, scene, scene.n_steps, scene.dt_ns, about(SCENES[name]))
            for name, scene in scenes.items()
        ],
        "recordings: sparseskin play NAME": [
            row(name, scenes[one.scene], one.n_frames, PERIOD_NS, one.about)
            for name, one in SCENARIOS.items()
        ],
    }.items():
        print("\n".join([title, *table(["NAME", "TAXELS", "FRAMES", "MS", "ABOUT"], rows, "  ")]))
    return 0


def _make(arguments: argparse.Namespace) -> int:
    """Make short recordings of scenes."""
    names = list(dict.fromkeys(arguments.names or SCENARIOS))
    for name in names:
        if name not in SCENARIOS:
            raise unknown_scenario(name)
    folder = arguments.out if arguments.out is not None else data_folder()
    for name in names:
        there = (folder / f"{name}{FILE_SUFFIX}").exists()
        path = make_scenario(name, folder)
        note = "is there already" if there else f"{SCENARIOS[name].n_frames} frames"
        print(f"{path}: {note}, {size_text(path.stat().st_size)}")
    return 0
