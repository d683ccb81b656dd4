"""A file format of another package, found by its entry point: `.tfr`, tactile frames.

The first line is JSON, {"format": "tfr", "rows", "cols", "unit", "rate_hz"}; frames of float32
follow, little-endian, row after row. It is made up, to show what a format has to do.
"""

import json

import numpy as np

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.format import Format
from sparseskin.nodes.sensor.files.recording import (
    MAX_LINE_BYTES,
    Block,
    File,
    Head,
    WholeRecording,
)
from sparseskin.nodes.sensor.layout.checks import check_number, check_unit, shown

MAX_SIDE = 4096
"""Most rows or columns, chosen: a number of the file must not make a frame of any size."""


def is_tfr(begin: bytes) -> bool:
    """True if a file begins like one of this format."""
    return begin.startswith(b'{"format": "tfr"')


class TfrRecording(WholeRecording):
    """Frames of a .tfr file. Raises SourceError, with the place, where it is malformed."""

    def __init__(self, file: File) -> None:
        super().__init__()
        self._file = file

    def read(self) -> tuple[Head, Block]:
        name = self._file.name
        head = self._head()
        shape = []
        for key in ("rows", "cols"):
            side = head.get(key)
            # `true` is an int of Python, too.
            if type(side) is not int or not 1 <= side <= MAX_SIDE:
                raise SourceError(
                    f"{name}, line 1: {key} = {shown(side)}; expected 1..{MAX_SIDE}"
                )
            shape.append(side)
        check_unit(f"{name}, line 1", head.get("unit"))
        check_number(f"{name}, line 1", "rate_hz", head.get("rate_hz"), 1e6)

        # What is left must be whole frames.
        data = self._file.file.read()
        n_bytes = 4 * shape[0] * shape[1]
        if not data or len(data) % n_bytes:
            raise SourceError(
                f"{name}: {len(data)} bytes behind line 1; a frame has {n_bytes}"
            )
        frames = np.frombuffer(data, "<f4").reshape(-1, *shape)
        if not np.isfinite(frames).all() or frames.min() < 0:
            raise SourceError(f"{name}: a reading is negative, or no finite number")
        properties = Head(unit=head.get("unit"), rate_hz=head.get("rate_hz"))
        return properties, Block(frames)

    def _head(self) -> dict:
        line = self._file.file.readline(MAX_LINE_BYTES)
        try:
            head = json.loads(line)
        except ValueError:
            head = None
        if not isinstance(head, dict):
            raise SourceError(
                f"{self._file.name}, line 1: expected JSON, as of {{...}}"
            )
        return head


TFR = Format({".tfr": "tactile frames"}, TfrRecording, is_tfr)
