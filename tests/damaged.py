"""Damaged files and wrong launch files, and the lines that refuse them."""

from collections.abc import Callable, Sequence

import pytest

from sparseskin.launch.launchfile.load import LaunchError, load
from sparseskin.nodes.errors import SparseskinError


def refusal(read: Callable[[], object], kind: type[SparseskinError] = SparseskinError) -> str:
    """The line of a refusal, which can be printed; "" where there is none."""
    line = ""
    try:
        read()
    except kind as error:
        line = str(error)
    assert line.isprintable(), line
    return line


def launch_faults(name: str, changes: Sequence[str] = ()) -> list[str]:
    """The lines that refuse a launch file."""
    with pytest.raises(LaunchError) as refused:
        load(name, changes)
    return list(refused.value.lines)


def changed(raw: bytes, place: int, piece: bytes) -> bytes:
    at = place % len(raw)
    return raw[:at] + piece + raw[at + len(piece) :]
