"""The commands `sparseskin play`, which publishes a recording and shows it on a live page, and
`scenes`, which lists launch files.
"""

import argparse
import sys
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
    from sparseskin.nodes.recorder.bag.reader import BagReader

PLAY_KEYS = {
    " ": ("player", "pause"),
    "right": ("player", "step"),
    "up": ("player", "faster"),
    "down": ("player", "slower"),
}
OPTIONS = {
    key: f"--{key.removesuffix('_s')}"
    for key in (
        "rate",
        "loop",
        "start_s",
        "duration_s",
        "topics",
        "lockstep",
        "wait",
    )
}
"""Settings of the player, and the options that state them."""


def configure_play(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Publish what was recorded, as it was recorded. Keys: space pauses, right plays one frame, "
        "up and down change the rate, q ends."
    )
    parser.add_argument("file", metavar="F.mcap", help="recording")
    parser.add_argument(
        "--rate",
        type=real(False),
        metavar="R",
        help="times the recorded speed; 0: as fast as it is read",
    )
    parser.add_argument(
        "--loop",
        action="store_true",
        default=None,
        help="start again at the end",
    )
    # The settings have a unit in their names, the options do not.
    seconds: dict[str, Any] = {"type": real(False), "metavar": "S"}
    parser.add_argument(
        "--start",
        dest="start_s",
        help="seconds to skip",
        **seconds,
    )
    parser.add_argument(
        "--duration",
        dest="duration_s",
        help="seconds to play",
        **seconds,
    )
    _add_rare_options(rare(parser))
    add_page(parser, "open a live page that shows it, again and again")
    parser.set_defaults(run=_play)


def _add_rare_options(group: Any) -> None:
    """What most users leave out, listed apart."""
    group.add_argument(
        "--topics",
        nargs="+",
        metavar="T",
        help="topics to play",
    )
    group.add_argument(
        "--lockstep",
        action="store_true",
        default=None,
        help="send no frame before all readers have handled the last",
    )
    group.add_argument(
        "--wait",
        type=whole(0),
        metavar="K",
        help="wait for K readers first",
    )
    group.add_argument("--pause", action="store_true", help="start paused")


def _play(arguments: argparse.Namespace) -> int:
    """Run a player as a graph of its own, which others may join; with a page, a monitor too."""
    from sparseskin.launch.launchfile.load import single_node
    from sparseskin.launch.run.launcher import Launcher
    from sparseskin.launch.run.terminal import Terminal

    if arguments.no_token and not arguments.open:
        raise SettingsError("--no-token: goes with --open: without it there is no page")
    path = Path(arguments.file)
    # What is not stated is left to the defaults of the player.
    stated = {key: getattr(arguments, key) for key in OPTIONS}
    values: dict[str, Any] = {
        key: value for key, value in stated.items() if value is not None
    }
    values["file"] = str(path)
    values["paused"] = arguments.pause
    # The stamps of a loop would go back: they are made anew.
    values["keep_stamps"] = not arguments.loop
    # A refusal names what the user typed, not the setting behind it.
    with naming_options(OPTIONS):
        if arguments.open:
            launch = _with_page(arguments, path, values)
        else:
            launch = replace(single_node("player", "player", values), name=path.stem)

    if not arguments.open:
        watch = f"sparseskin monitor --graph {launch.name}"
        print(f"to see it: --open, or from another terminal {watch}", file=sys.stderr)
    launcher = Launcher(launch, Terminal(), keys=PLAY_KEYS)
    code = launcher.run()
    print_ends(launcher.summary()["nodes"])
    return code


def _with_page(
    arguments: argparse.Namespace, path: Path, values: dict[str, Any]
) -> "LaunchFile":
    """A player and a monitor with its page, or SettingsError if there is too little to show."""
    from sparseskin.launch.launchfile.load import load_tables
    from sparseskin.nodes.monitor.node import OPTIONAL, REQUIRED
    from sparseskin.nodes.recorder.bag.patches import names_of
    from sparseskin.nodes.recorder.bag.reader import BagReader

    if arguments.topics:
        raise SettingsError(
            "--topics: does not go with --open, which plays what it shows"
        )
    # What is shown depends on what was recorded.
    with BagReader(path) as bag:
        batches = names_of(bag)
        schemas_of = _recorded_schemas(bag)

    # The page shows what all patches have.
    present: set[str] = set()
    if schemas_of:
        present = set.intersection(*schemas_of.values())
    # A page without reconstructions would stay empty.
    required = [cls.schema for cls in REQUIRED]
    optional = [cls.schema for cls in OPTIONAL if cls.schema in present]
    if not present.issuperset(required):
        raise SettingsError(
            f"{path}: --open: has no reconstructions of all patches; they are computed by "
            f"sparseskin launch replay_taxels --open --set player.file={path}, or by "
            "replay_measurements"
        )

    player = {
        "type": "player",
        **values,
        # Of frames that are played now: their stamps, and so their ages, are those of now.
        "loop": True,
        "keep_stamps": False,
        "schemas": [*required, *optional],
    }
    monitor = {
        "type": "monitor",
        "patches": [patch for patch in schemas_of if patch not in batches],
        "batches": batches,
        "browser": True,
        "token": not arguments.no_token,
    }
    return load_tables(path.stem, {"player": player, "monitor": monitor})


def _recorded_schemas(bag: "BagReader") -> dict[str, set[str]]:
    """Schemas of each patch or batch of which a recording has messages."""
    from sparseskin.messages.topics import split_topic

    schemas_of: dict[str, set[str]] = {}
    for topic, info in bag.topics.items():
        if info.n_messages:
            patch, schema = split_topic(topic)
            schemas_of.setdefault(patch, set()).add(schema)
    return schemas_of


def configure_scenes(parser: argparse.ArgumentParser) -> None:
    parser.description = "List the graphs that launch knows by name."
    parser.set_defaults(run=_scenes)


def _scenes(arguments: argparse.Namespace) -> int:
    rows = []
    for name in bundled_names():
        launch = tomllib.loads((BUNDLED / f"{name}.toml").read_text("utf-8"))
        rows.append([name, launch["graph"]["description"]])
    print("\n".join(table(["NAME", "ABOUT"], rows, "  ")))
    return 0
