"""The command `sparseskin design`: what a skin would deliver, before it is built."""

from __future__ import annotations

import argparse
import csv
from contextlib import ExitStack
from pathlib import Path

from sparseskin.launch.commands.options import whole
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.files import whole_file
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.sensor.files.recording import shown
from sparseskin.nodes.sensor.scenes.presses import BODIES

from .simulation import FEW_SCENES, N_SCENES
from .spec import KEYS, SIZE_KEYS, Design, make_design, read_file


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `design`."""
    parser.description = (
        "Compare ways to read a skin that is not built yet: wires, rate and its limit, bytes,\n"
        "accuracy, latency, cores. State it by options, by a file with the same keys, or by both:\n"
        "options replace what the file states."
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("file", metavar="design.toml", nargs="?", type=Path, help="file of keys")
    for name, key in KEYS.items():
        default = "" if key.default is None else f" (default: {key.default})"
        about = f"{key.about}{default}"
        parser.add_argument(f"--{name}", metavar=key.form, help=about)
    about = "write the table to this file too, with all digits"
    parser.add_argument("--csv", metavar="FILE", type=Path, help=about)
    about = "strategies of the table, with commas between them (default: all)"
    parser.add_argument("--only", metavar="NAMES", help=about)
    about = f"what presses the simulated skin: {', '.join(BODIES)} (default: all)"
    parser.add_argument("--scene", metavar="BODY", choices=BODIES, help=about)
    about = f"simulated scenes, 2..{N_SCENES}: more take longer (default: {FEW_SCENES})"
    counts = range(2, N_SCENES + 1)
    parser.add_argument(
        "--scenes", metavar="K", type=int, choices=counts, default=FEW_SCENES, help=about
    )
    about = "seed of scenes, noise and Phi (default: 0)"
    parser.add_argument("--seed", metavar="K", type=whole(0), default=0, help=about)
    about = "no figures of accuracy: nothing is simulated"
    parser.add_argument("--no-accuracy", action="store_true", help=about)
    parser.set_defaults(run=_design)


def _design(arguments: argparse.Namespace) -> int:
    from . import text
    from .budget import budget

    design = design_of(arguments)
    rows = budget(design, _names(arguments.only))
    with ExitStack() as stack:
        draft = arguments.csv and stack.enter_context(whole_file(arguments.csv))
        if not arguments.no_accuracy:
            from .accuracy import simulated

            stated = {"scene": arguments.scene, "n_scenes": arguments.scenes}
            rows = simulated(rows, design, arguments.seed, **stated)
        print(text.terminal(rows, design))
        if draft is not None:
            records = [text.record(row, design) for row in rows]
            with draft.open("w", newline="") as file:
                writer = csv.DictWriter(file, records[0])
                writer.writeheader()
                writer.writerows(records)
    return 0


def design_of(arguments: argparse.Namespace) -> Design:
    """The design that options and file state; SettingsError has a line for each that is wrong."""
    options = {key: value for key in KEYS if (value := getattr(arguments, key)) is not None}
    stated = {} if arguments.file is None else read_file(arguments.file)
    if any(key in options for key in SIZE_KEYS):
        stated = {key: value for key, value in stated.items() if key not in SIZE_KEYS}

    def place(key: str) -> str:
        if key in options or key not in stated:
            return f"--{key}: "
        return f"{arguments.file}: {key if key in KEYS else shown(key)}: "

    return make_design({**stated, **options}, place)


def _names(text: str | None) -> list[str] | None:
    """Names of strategies that --only states; SettingsError if one is not known."""
    from .strategies import STRATEGIES

    if text is None:
        return None
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in STRATEGIES:
            hint = nearest_of(name, STRATEGIES)
            raise SettingsError(f"--only: strategy {name[:40]!r} is not known{hint}")
    return names
