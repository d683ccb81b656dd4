"""The command `sparseskin design`: what a skin would deliver, before it is built."""

from __future__ import annotations

import argparse
import csv
import sys
from contextlib import ExitStack
from pathlib import Path

from sparseskin.launch.commands.options import rare
from sparseskin.nodes.files import whole_file
from sparseskin.nodes.sensor.files.recording import shown

from .spec import KEYS, SIZE_KEYS, Design, make_design, read_file
from .strategies import FEW_SCENES, N_SCENES, STRATEGIES

RARE_KEYS = ("points", "taxels", "pitch", "converters", "settling", "sums", "bits", "edge", "host")
"""Keys whose options most users leave out."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `design`."""
    parser.description = (
        "Compare ways to read a skin that is not built yet: wires, rate and what limits it, bytes, "
        "accuracy, latency, cores. State it by options, or by a file with the same keys, or by "
        "both: options replace what the file states."
    )
    more = rare(parser)
    parser.add_argument("file", metavar="design.toml", nargs="?", type=Path, help="file of keys")
    for name, key in KEYS.items():
        default = "" if key.default is None else f" (default: {key.default})"
        place = more if name in RARE_KEYS else parser
        place.add_argument(
            f"--{name.replace('_', '-')}", metavar=key.form, help=f"{key.about}{default}"
        )
    about = "write all figures to this file too, with all digits"
    parser.add_argument("--csv", metavar="FILE", type=Path, help=about)
    about = "rates, bytes and wires alone, at once: nothing is simulated"
    parser.add_argument("--no-accuracy", action="store_true", help=about)
    about = f"simulated scenes, 2..{N_SCENES}: more take longer (default: {FEW_SCENES})"
    scenes = range(2, N_SCENES + 1)
    more.add_argument(
        "--scenes", metavar="K", type=int, choices=scenes, default=FEW_SCENES, help=about
    )
    parser.set_defaults(run=_design)


def _design(arguments: argparse.Namespace) -> int:
    design = design_of(arguments)
    with ExitStack() as stack:
        draft = arguments.csv and stack.enter_context(whole_file(arguments.csv))
        if not arguments.no_accuracy:
            n = len(STRATEGIES)
            few = arguments.scenes
            begun = f"{design.size}, {n} ways to read them in {few} simulated scenes each ..."
            print(begun, file=sys.stderr, flush=True)
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
    options = {key: value for key in KEYS if (value := getattr(arguments, key)) is not None}
    stated = {} if arguments.file is None else read_file(arguments.file)
    if any(key in options for key in SIZE_KEYS):
        stated = {key: value for key, value in stated.items() if key not in SIZE_KEYS}

    def place(key: str) -> str:
        if key in options or key not in stated:
            return f"--{key.replace('_', '-')}: "
        return f"{arguments.file}: {key if key in KEYS else shown(key)}: "

    return make_design({**stated, **options}, place)
