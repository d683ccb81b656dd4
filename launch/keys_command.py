"""The command `sparseskin keys`: key pairs for graphs that others could reach."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from sparseskin.nodes.keys import make_key_files

FOLDER = "keys"


def add_keys_parser(commands: Any) -> None:
    """Add `keys` and its commands to the commands."""
    keys = commands.add_parser(
        "keys",
        help="make keys, so that only your hosts read and write a graph",
        description="Key pairs, one a host: its secret stays there, its public key goes to the "
        "others.",
    )
    kinds = keys.add_subparsers(required=True, metavar="COMMAND")
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
    secret, public = make_key_files(arguments.name, arguments.dir)
    print(f"{secret}: the secret key of {arguments.name}; it stays on that host")
    print(f"{public}: its public key; copy it to the folder of keys of each peer")
    return 0
