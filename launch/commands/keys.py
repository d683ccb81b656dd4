"""The command `sparseskin keys`: key pairs for graphs that others could reach."""

from __future__ import annotations

import argparse
from pathlib import Path

from .options import add_commands

FOLDER = "keys"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `keys`."""
    about = "Key pairs, one a host: its secret stays there, its public key goes to the others."
    make = add_commands(parser, about)("make", _make, "make a key pair")
    make.add_argument("name", metavar="NAME", help="name of the key, as a rule that of the host")
    about = f"folder to write to (default: {FOLDER})"
    make.add_argument("--dir", metavar="D", type=Path, default=Path(FOLDER), help=about)


def _make(arguments: argparse.Namespace) -> int:
    """Write NAME.key, the secret, which only you can read, and NAME.pub."""
    from sparseskin.nodes.network.keys import make_key_files

    secret, public = make_key_files(arguments.name, arguments.dir)
    print(f"{secret}: the secret key of {arguments.name}; it stays on that host")
    print(f"{public}: its public key; copy it to the folder of keys of each peer")
    return 0
