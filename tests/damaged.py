"""Damaged files and wrong launch files, and the lines that refuse them."""

import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from sparseskin.launch.launchfile.load import LaunchError, load
from sparseskin.nodes.errors import SparseskinError


def refusal(
    read: Callable[[], object], kind: type[SparseskinError] = SparseskinError
) -> str:
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


def mutated(data: st.DataObject, raw: bytes) -> bytes:
    """A copy of which some parts are replaced, drawn by hypothesis."""
    made = bytearray(raw)
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(made)))
        made[start : start + data.draw(st.integers(0, 9))] = data.draw(
            st.binary(max_size=9)
        )
    return bytes(made)


def npy(array: Any) -> bytes:
    """An array as the bytes of a file .npy."""
    made = io.BytesIO()
    np.save(made, array)
    return made.getvalue()


def npz(**arrays: Any) -> bytes:
    made = io.BytesIO()
    np.savez_compressed(made, **arrays)
    return made.getvalue()
