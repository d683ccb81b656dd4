"""Plug-in `edge`: a compressor outside the graph: its program in C, and the node that reads its
frames.
"""

import argparse

HELP = "export a compressor in C for a board"
GROUP = "Build a skin"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `sparseskin edge`."""
    from .command import configure

    configure(parser)
