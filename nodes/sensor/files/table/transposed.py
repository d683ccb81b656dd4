"""Tables with a line for each taxel and a column for each frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.sensor.files.recording import (
    Block,
    File,
    Head,
    Recording,
)
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.tally import Tally
from sparseskin.nodes.sensor.layout.times import named_unit

from .columns import time_of_rows
from .table import TableRecording

OF_LINES = {"time": "none", "columns": "", "n_rows": None, "n_cols": None}
"""What is stated of the frames, and not of the lines."""


class TransposedTable(Recording):
    """A table whose lines are taxels, or the times, and whose columns are frames, as `axes` states.
    A text before the numbers of a line is its name. It is read whole, since each frame stands all
    over the file.
    """

    def __init__(self, file: File) -> None:
        self.tally = Tally("columns")
        self._file = file
        self._layout = file.layout
        # A line is read as if it were a frame: the rules of tables hold for it.
        of_lines = replace(file, layout=file.layout.stating(OF_LINES))
        self._lines = TableRecording(of_lines)

    def head(self) -> Head:
        names = self._names
        time, notes = self._time
        axis = Axis(len(names), "lines", names)
        usable = tuple(k for k in range(len(names)) if k != time)
        head = Head((axis,), usable, asks_unit=True, notes=notes)
        if time is None:
            return head
        return replace(
            head,
            is_timed=True,
            time_unit=self._layout.time_unit or named_unit(names[time]),
            time_name=f"line {names[time] or time + 1}",
        )

    def blocks(self) -> Iterator[Block]:
        self.tally.begin()
        frames = self._frames
        time, _ = self._time
        times = None if time is None else frames[:, time].tolist()
        for block in Block(frames, times).parts():
            self.tally.take(len(block.numbers), len(block.numbers))
            yield block

    @cached_property
    def _frames(self) -> Doubles:
        """Numbers of all frames, (n_frames, n_lines)."""
        columns = list(self._lines.numeric)
        parts = [block.numbers[:, columns] for block in self._lines.blocks()]
        return np.concatenate(parts).T

    @cached_property
    def _names(self) -> tuple[str, ...]:
        """Names of the lines, "" of those that have none."""
        # Without names the lines count; their order is that of the taxels.
        names = self._lines.texts_of_lines()
        return names or ("",) * self._frames.shape[1]

    @cached_property
    def _time(self) -> tuple[int | None, tuple[str, ...]]:
        """The line of the times, and what is to be said."""
        name = self._file.name
        return time_of_rows(self._names, self._frames, self._layout, name)
