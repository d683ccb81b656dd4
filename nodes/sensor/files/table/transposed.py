"""Tables with a line for each taxel and a column for each frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.sensor.files.recording import (
    Block,
    File,
    Head,
    Recording,
)
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.names import matching
from sparseskin.nodes.sensor.layout.tally import Tally
from sparseskin.nodes.sensor.layout.times import is_time_name, named_unit

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
        of_lines = replace(file, layout=file.layout.stating(OF_LINES))
        self._lines = TableRecording(of_lines)

    def head(self) -> Head:
        names = self._names
        time = self._time
        axis = Axis(len(names), "lines", names)
        usable = tuple(k for k in range(len(names)) if k != time)

        if time is None:
            return Head((axis,), usable, asks_unit=True)
        return Head(
            (axis,),
            usable,
            is_timed=True,
            time_unit=self._layout.time_unit or named_unit(names[time]),
            time_name=f"line {names[time] or time + 1}",
            asks_unit=True,
        )

    def blocks(self) -> Iterator[Block]:
        self.tally.begin()
        frames = self._frames
        times = None if self._time is None else frames[:, self._time].tolist()
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
        names = self._lines.texts_of_lines()
        return names or ("",) * self._frames.shape[1]

    @cached_property
    def _time(self) -> int | None:
        """The line of the times."""
        setting = self._layout.time
        names = self._names
        if setting == "none":
            return None
        ends = {"first": 0, "last": len(names) - 1}
        if setting in ends:
            return ends[setting]
        if setting:
            lines = matching(setting, names, len(names), self._file.name, "time")
        else:
            lines = [k for k, name in enumerate(names) if name and is_time_name(name)]
        return _only(lines, self._file) if lines else None


def _only(lines: Sequence[int], file: File) -> int:
    if len(lines) > 1:
        raise SourceError(
            f"{file.name}: {len(lines)} lines may be the times; state time, as first"
        )
    return lines[0]
