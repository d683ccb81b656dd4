"""Options of the commands that read a topic, and how their values are read."""

from __future__ import annotations

import argparse
import math


def add_end_options(parser: argparse.ArgumentParser) -> None:
    """Add -n and --duration, by which a command that reads a topic ends by itself."""
    parser.add_argument("-n", metavar="K", type=at_least_one, help="end after K messages")
    parser.add_argument("--duration", metavar="S", type=seconds, help="end after S seconds")


def at_least_one(text: str) -> int:
    """A whole number, 1 or more."""
    return _whole(text, 1)


def at_least_two(text: str) -> int:
    """A whole number, 2 or more."""
    return _whole(text, 2)


def seconds(text: str) -> float:
    """A number above 0."""
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a number above 0")
    return value


def rate(text: str) -> float:
    """A number, 0 or more."""
    value = _number(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a number, 0 or more")
    return value


def _whole(text: str, low: int) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 16) or int(text) < low:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number, {low} or more")
    return int(text)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
