"""Plug-in `recogniser`: a node that labels what presses, and the command that trains its model."""

import argparse

HELP = "train a model that labels what presses"
GROUP = "Data"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `sparseskin tasks`."""
    from .command import configure

    configure(parser)
