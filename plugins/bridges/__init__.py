"""Plug-in `bridges`: observers that show a graph to other tools, and exports of bags to them."""

import argparse

HELP = "show a running graph to Foxglove or ROS 2"
GROUP = "Look"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `sparseskin bridge`."""
    from .command import configure

    configure(parser)
