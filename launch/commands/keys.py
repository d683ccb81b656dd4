"""The command `sparseskin keys`: key pairs for graphs that others could reach."""

from __future__ import annotations

import argparse
from pathlib import Path

FOLDER = "keys"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `keys`."""
    parser.description = (
        "Key pairs, one a host: its secret stays there, its public key goes to the others."
    )
    kinds = parser.add_subparsers(required=True, metavar="COMMAND")
    make = kinds.add_parser(
        "make",
        help="make a key pair",
        description="Write NAME.key, the secret, which only you can read, and NAME.pub.",
    )
    make.add_argument("name", metavar="NAME", help="name of the key, as a rule that of the host")
    make.add_argument(
        "--dir",
        metavar="D",
        type=Path,
        default=Path(FOLDER),
        help=f"folder to write to (default: {FOLDER})",
    )
    make.set_defaults(run=_make)


def _make(arguments: argparse.Namespace) -> int:
    from sparseskin.nodes.network.keys import make_key_files

    secret, public = make_key_files(arguments.name, arguments.dir)
    print(f"{secret}: the secret key of {arguments.name}; it stays on that host")
    print(f"{public}: its public key; copy it to the folder of keys of each peer")
    return 0
