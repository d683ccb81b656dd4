"""The command `sparseskin edge`: a compressor in C99 for a microcontroller."""

import argparse
from pathlib import Path
from typing import Any

from sparseskin.launch.commands.options import add_commands, naming_options, rare

_OPTIONS = {
    "n_rows": "--n-rows",
    "n_cols": "--n-cols",
    "m": "--m",
    "ratio": "--ratio",
    "bits": "--bits",
    "rows": "--rows-mode",
    "block": "--block",
    "seed": "--seed",
    "adc_bits": "--adc-bits",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `edge`."""
    from sparseskin.nodes.compressor.phi.rotation import RATIO

    add = add_commands(parser, "A compressor in C99 for the board beside the skin.")
    make = add("export", _export, "write its program")
    make.add_argument(
        "--n-rows",
        metavar="R",
        type=int,
        help="rows of taxels",
    )
    make.add_argument(
        "--n-cols",
        metavar="C",
        type=int,
        help="columns of taxels",
    )
    make.add_argument(
        "--ratio", type=float, help=f"taxels a measurement (default: {RATIO:g})"
    )
    make.add_argument(
        "--bits",
        type=int,
        default=8,
        help="bits of a measurement, 4..16 (default: 8)",
    )
    make.add_argument(
        "--adc-bits",
        metavar="BITS",
        type=int,
        default=12,
        help="bits of a reading, 1..16: counts are 0 .. 2^bits - 1 (default: 12)",
    )
    make.add_argument(
        "--skin",
        metavar="skin.toml",
        type=Path,
        help="rows, columns, mask of a skin",
    )
    make.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        required=True,
        help="folder to write to, a new one",
    )
    _add_rare_options(make)


def _add_rare_options(make: argparse.ArgumentParser) -> None:
    """Options of the matrix that most users leave out, listed apart."""
    from sparseskin.nodes.compressor.phi.base import BLOCK
    from sparseskin.nodes.compressor.phi.rotation import ROWS

    group = rare(make)
    group.add_argument(
        "--m",
        metavar="M",
        type=int,
        help="number of measurements, for --ratio",
    )
    about = "rows of the matrix: the same in each frame or not (default: as the compressor chooses)"
    group.add_argument("--rows-mode", choices=ROWS, help=about)
    group.add_argument(
        "--block",
        metavar="B",
        type=int,
        default=BLOCK,
        help=f"size of the Hadamard blocks (default: {BLOCK})",
    )
    group.add_argument(
        "--seed",
        type=int,
        default=0,
        help="seed of the matrix (default: 0)",
    )


def _export(arguments: argparse.Namespace) -> int:
    """Write the compressor of a skin as portable C99, without a heap and in integers.

    Its frames are those of the compressor node for the same counts, bit for bit. A node of type
    edge reads them: sparseskin launch edge.
    """
    from sparseskin.nodes.compressor.phi.rotation import RATIO
    from sparseskin.nodes.errors import SettingsError
    from sparseskin.plugins.edge.description import EdgeDescription
    from sparseskin.plugins.edge.export import export

    # Both state the number of measurements, and may contradict each other.
    if arguments.m is not None and arguments.ratio is not None:
        raise SettingsError("--m: states the number of measurements; leave out --ratio")
    mask: Any = None
    n_rows = arguments.n_rows
    n_cols = arguments.n_cols
    if arguments.skin is not None:
        if n_rows is not None or n_cols is not None:
            raise SettingsError(
                "--skin: states rows and columns; leave out --n-rows and --n-cols"
            )

        from sparseskin.nodes.sensor.skin_file import load_skin

        skin = load_skin(arguments.skin).skin
        n_rows = skin.n_rows
        n_cols = skin.n_cols
        mask = skin.mask
    elif n_rows is None or n_cols is None:
        missing = "--n-rows" if n_rows is None else "--n-cols"
        raise SettingsError(
            f"{missing}: is missing; state --n-rows and --n-cols, or --skin"
        )

    with naming_options(_OPTIONS):
        described = EdgeDescription.chosen(
            n_rows,
            n_cols,
            ratio=RATIO if arguments.ratio is None else arguments.ratio,
            rows=arguments.rows_mode,
            mask=mask,
            m=arguments.m,
            bits=arguments.bits,
            block=arguments.block,
            seed=arguments.seed,
            adc_bits=arguments.adc_bits,
        )
    export(described, arguments.out)
    print(
        f"{arguments.out}: {described.m} of {described.n_taxels} taxels, rows {described.rows}, "
        f"{described.bits} bits, {described.frame_bytes} bytes a frame; try make test there"
    )
    return 0
