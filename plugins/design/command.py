"""The command `sparseskin design`: what a skin would deliver, before it is built."""

import argparse
import csv
import sys
from contextlib import ExitStack
from pathlib import Path

from sparseskin.launch.commands.options import rare
from sparseskin.nodes.files import whole_file
from sparseskin.nodes.sensor.layout.checks import shown

from .spec import KEYS, SIZE_KEYS, Design, make_design, read_file
from .strategies import FEW_SCENES, N_SCENES, STRATEGIES

RARE_KEYS = (
    "points",
    "taxels",
    "pitch",
    "converters",
    "settling",
    "sums",
    "bits",
    "edge",
    "host",
)
"""Keys whose options most users leave out."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `design`."""
    parser.description = (
        "Compare ways to read a skin that is not built yet: wires, rate and what limits it, bytes, "
        "accuracy, latency, cores. State it by options, or by a file with the same keys, or by "
        "both: options replace what the file states."
    )
    rare_options = rare(parser)
    parser.add_argument(
        "file",
        metavar="design.toml",
        nargs="?",
        type=Path,
        help="file of keys",
    )
    for name, key in KEYS.items():
        about = key.about
        if key.default is not None:
            about = f"{about} (default: {key.default})"
        place = rare_options if name in RARE_KEYS else parser
        place.add_argument(f"--{name.replace('_', '-')}", metavar=key.form, help=about)

    parser.add_argument(
        "--csv",
        metavar="FILE",
        type=Path,
        help="write all figures to this file too, with all digits",
    )
    parser.add_argument(
        "--no-accuracy",
        action="store_true",
        help="rates, bytes and wires alone, at once: nothing is simulated",
    )
    about = f"simulated scenes, 2..{N_SCENES}: more take longer (default: {FEW_SCENES})"
    scenes = range(2, N_SCENES + 1)
    rare_options.add_argument(
        "--scenes",
        metavar="K",
        type=int,
        choices=scenes,
        default=FEW_SCENES,
        help=about,
    )
    parser.set_defaults(run=_design)


def _design(arguments: argparse.Namespace) -> int:
    design = design_of(arguments)
    # A file that cannot be written is refused before anything is simulated.
    with ExitStack() as stack:
        draft = arguments.csv and stack.enter_context(whole_file(arguments.csv))
        if not arguments.no_accuracy:
            print(
                f"{design.size}, {len(STRATEGIES)} ways to read them in {arguments.scenes} "
                "simulated scenes each ...",
                file=sys.stderr,
                flush=True,
            )

        # Imported here, where all that is stated has been checked and reported.
        from . import text
        from .budget import budget

        rows = budget(design)
        if not arguments.no_accuracy:
            from .simulation import simulated

            rows = simulated(rows, design, arguments.scenes)
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
    options = {}
    for key in KEYS:
        value = getattr(arguments, key)
        if value is not None:
            options[key] = value

    of_file = {}
    if arguments.file is not None:
        of_file = read_file(arguments.file)
    # Options that state a size replace all of that in the file.
    if any(key in options for key in SIZE_KEYS):
        of_file = {key: value for key, value in of_file.items() if key not in SIZE_KEYS}

    def place(key: str) -> str:
        if key in options or key not in of_file:
            return f"--{key.replace('_', '-')}: "
        name = key if key in KEYS else shown(key)
        return f"{arguments.file}: {name}: "

    return make_design({**of_file, **options}, place)
