"""Plug-in `design`: speed, bytes, wires and accuracy of a skin that is not built yet."""

import argparse
import os

HELP = "compare ways to read a skin before it is built"
GROUP = "Build a skin"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `sparseskin design`."""
    # Read as numpy is imported: strategies are simulated side by side, in a process each core.
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    from .command import configure

    configure(parser)
