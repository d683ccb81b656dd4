"""The commands `sparseskin play`, which publishes a recording and shows it on a live page, and
`scenes`, which lists launch files.
"""

import argparse
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.launch.attach.text import table
from sparseskin.launch.launchfile import BUNDLED, bundled_names
from sparseskin.nodes.errors import SettingsError

from .options import add_page, naming_options, print_ends, rare, real, whole

if TYPE_CHECKING:
    from sparseskin.launch.launchfile.spec import LaunchFile

PLAY_KEYS = {
    " ": ("player", "pause"),
    "right": ("player", "step"),
    "up": ("player", "faster"),
    "down": ("player", "slower"),
}
OPTIONS = {
    key: f"--{key.removesuffix('_s')}"
    for key in ("rate", "loop", "start_s", "duration_s", "topics", "remap", "lockstep", "wait")
}
"""Settings of the player, and the options that state them."""


def configure_play(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Publish what was recorded, as it was recorded. Keys: space pauses, right plays one frame, "
        "up and down change the rate, q ends."
    )
    more = rare(parser)
    parser.add_argument("file", metavar="F.mcap", help="recording")
    about = "times the recorded speed; 0: as fast as it is read"
    parser.add_argument("--rate", type=real(False), metavar="R", help=about)
    parser.add_argument("--loop", action="store_true", default=None, help="start again at the end")
    seconds: dict[str, Any] = {"type": real(False), "metavar": "S"}
    parser.add_argument("--start", dest="start_s", help="seconds to skip", **seconds)
    parser.add_argument("--duration", dest="duration_s", help="seconds to play", **seconds)
    more.add_argument("--topics", nargs="+", metavar="T", help="topics to play")
    about = "other names for topics or patches"
    more.add_argument("--remap", nargs="+", metavar="A:=B", help=about)
    about = "send no frame before all readers have handled the last"
    more.add_argument("--lockstep", action="store_true", default=None, help=about)
    more.add_argument("--wait", type=whole(0), metavar="K", help="wait for K readers first")
    more.add_argument("--pause", action="store_true", help="start paused")
    add_page(parser, "open a live page that shows it, again and again")
    parser.set_defaults(run=_play)


def _play(arguments: argparse.Namespace) -> int:
    """Run a player as a graph of its own, which others may join; with a page, a monitor too."""
    from sparseskin.launch.launchfile.load import single_node
    from sparseskin.launch.run.launcher import Launcher
    from sparseskin.launch.run.terminal import Terminal

    if arguments.no_token and not arguments.open:
        raise SettingsError("--no-token: goes with --open: without it there is no page")
    path = Path(arguments.file)
    stated = {key: getattr(arguments, key) for key in OPTIONS}
    values: dict[str, Any] = {
        **{key: value for key, value in stated.items() if value is not None},
        "file": str(path),
        "paused": arguments.pause,
        "keep_stamps": not arguments.loop,
    }
    with naming_options(OPTIONS):
        if arguments.open:
            launch = _with_page(arguments, path, values)
        else:
            launch = replace(single_node("player", "player", values), name=path.stem)
    launcher = Launcher(launch, Terminal(), keys=PLAY_KEYS)
    code = launcher.run()
    print_ends(launcher.summary()["nodes"])
    return code


def _with_page(arguments: argparse.Namespace, path: Path, values: dict[str, Any]) -> "LaunchFile":
    """A player and a monitor with its page, or SettingsError if there is too little to show."""
    from sparseskin.launch.launchfile.load import load_tables
    from sparseskin.messages.topics import split_topic
    from sparseskin.nodes.monitor.node import OPTIONAL, REQUIRED
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
    present = set.intersection(*by_patch.values()) if by_patch else set()
    required, optional = ([cls.schema for cls in classes] for classes in (REQUIRED, OPTIONAL))
    if not present.issuperset(required):
        raise SettingsError(
            f"{path}: --open: has no reconstructions of all patches; they are computed by "
            f"sparseskin launch replay_taxels --open --set player.file={path}, or by "
            "replay_measurements"
        )
    # Of frames that are played now: their stamps, and so their ages, are those of now.
    values |= {"loop": True, "keep_stamps": False}
    values["schemas"] = [*required, *(schema for schema in optional if schema in present)]
    watched = {"patches": [patch for patch in by_patch if patch not in batches], "batches": batches}
    page = {"browser": True, "token": not arguments.no_token}
    tables = {"player": {"type": "player", **values}, "monitor": {"type": "monitor"}}
    tables["monitor"] |= watched | page
    return load_tables(path.stem, tables)


def configure_scenes(parser: argparse.ArgumentParser) -> None:
    parser.description = "List the graphs that launch knows by name."
    parser.set_defaults(run=_scenes)


def _scenes(arguments: argparse.Namespace) -> int:
    graphs = {n: tomllib.loads((BUNDLED / f"{n}.toml").read_text("utf-8")) for n in bundled_names()}
    rows = [[name, graph["graph"]["description"]] for name, graph in graphs.items()]
    print("\n".join(table(["NAME", "ABOUT"], rows, "  ")))
    return 0
