"""Tables with a line for each taxel of each frame: columns of frame, row, column and value."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.sensor.files.recording import Block
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.names import COL_WORDS, ROW_WORDS, last_part
from sparseskin.nodes.sensor.layout.roles import COLS, FRAMES, ROWS, TAXELS, VALUE
from sparseskin.nodes.sensor.layout.times import is_time_name

from .sample import FRAME_WORDS, LongColumns, Parsed, TableHead

TAXEL_WORDS = [
    "taxel",
    "taxel_id",
    "sensor",
    "sensor_id",
    "channel",
    "cell",
    "electrode",
    "id",
    "variable",
]
"""Names of columns that state which taxel a line is of."""
VALUE_WORDS = [
    "value",
    "val",
    "v",
    "force",
    "pressure",
    "reading",
    "data",
    "count",
    "counts",
]
MAX_SPARSE = 1000
"""Most taxels per line of a table; chosen: memory is used for each of them."""
SIDES = ([ROWS, COLS], [TAXELS])
"""What states the place of a taxel."""


def long_columns(head: TableHead) -> LongColumns | None:
    """The columns of a table with a line for each taxel, as `axes` or their names state them; None
    of other tables.
    """
    axes = head.layout.axis_names
    if VALUE in axes:
        sides = [axis for axis in (ROWS, COLS, TAXELS) if axis in axes]
        if len(axes) != head.width or FRAMES not in axes or sides not in SIDES:
            fault = f"axes = {head.layout.axes}, of lines of {head.width} columns"
            ways = "frames, value, and rows and cols or taxels; - for other columns"
            raise SourceError(f"{head.name}: {fault}; allowed: {ways}")
        places = tuple(map(axes.index, sides))
        return LongColumns(axes.index(FRAMES), places, axes.index(VALUE))
    if axes:
        return None

    names = [last_part(name) for name in head.names]

    def only(words: Sequence[str], columns: Sequence[int]) -> int | None:
        fitting = [k for k in columns if names[k] in words]
        if len(fitting) != 1:
            return None
        return fitting[0]

    row = only((*ROW_WORDS, "i"), head.numeric)
    col = only((*COL_WORDS, "j"), head.numeric)
    # Taxels may have numbers, or names.
    taxel = only(TAXEL_WORDS, head.numeric)
    if taxel is None:
        taxel = only(TAXEL_WORDS, range(head.width))
    columns = [row, col]
    if row is None and col is None:
        columns = [taxel]
    frames = [k for k in head.numeric if names[k] in FRAME_WORDS]
    frames += [k for k in range(head.width) if is_time_name(names[k])]
    unused = [k for k in head.numeric if k not in (*columns, *frames)]
    value = only(VALUE_WORDS, unused)
    if len(unused) == 1:
        value = unused[0]
    if not frames or value is None or None in columns:
        return None
    return LongColumns(frames[0], tuple(k for k in columns if k is not None), value)


class LongFrames:
    """The frames of lines that are of a taxel each. Where the lines of a frame do not follow each
    other, all are read before the first frame: `rows` reads them, each time that it is called.
    """

    def __init__(
        self,
        head: TableHead,
        columns: LongColumns,
        rows: Callable[[], Iterator[Parsed]],
    ) -> None:
        self._name = head.name
        self._head = head
        self._columns = columns
        self._rows = rows
        self._is_timed = columns.frame == head.time
        keys = head.cells(columns.frame)
        begins = [k for k, key in enumerate(keys) if k == 0 or key != keys[k - 1]]
        #: Lines of the first frame.
        self._n_first = 0
        if len(begins) > 1:
            self._n_first = begins[1]
        has_numbers = {*columns.places} <= {*head.numeric}
        # The first frame has to be whole in the begin of the file: it shows the others.
        is_in_turn = len(begins) == len({*keys}) and self._n_first > 1
        self._is_ordered = is_in_turn and has_numbers

    @cached_property
    def axes(self) -> tuple[Axis, ...]:
        """Axes of a frame."""
        _, sizes = self._places
        if len(sizes) > 1:
            return Axis(sizes[0], "rows"), Axis(sizes[1], "cols")
        return (Axis(sizes[0], "taxels", tuple(self._head.taxels)),)

    def blocks(self) -> Iterator[tuple[Block, int]]:
        """Blocks of frames, and the number of lines of each."""
        rows = np.empty((0, self._head.width))
        times: list[int | float] = []
        for part in self._parts():
            rows = np.concatenate([rows, part.numbers])
            times += part.times or []
            keys = self._keys(rows, times)
            begins = np.flatnonzero(np.diff(keys, prepend=np.nan) != 0)
            # The last frame may go on in the next lines.
            stop = int(begins[-1])
            if stop:
                yield self._pivoted(rows[:stop], begins[:-1], times), stop
            rows = rows[stop:]
            times = times[stop:]
        if len(rows):
            yield self._pivoted(rows, np.array([0]), times), len(rows)

    def _parts(self) -> Iterator[Parsed]:
        """Lines, those of each frame after the other."""
        if self._is_ordered:
            yield from self._rows()
            return
        parts = list(self._rows())
        rows = np.concatenate([part.numbers for part in parts])
        times = [time for part in parts for time in part.times or ()]
        order = np.argsort(self._keys(rows, times), kind="stable")
        sorted_times = [times[k] for k in order] if times else None
        yield Parsed((), rows[order], sorted_times)

    def _keys(self, rows: Doubles, times: Sequence[int | float]) -> npt.NDArray[Any]:
        """Numbers or times of the frames of lines."""
        if self._is_timed:
            return np.array(times)
        return rows[:, self._columns.frame]

    @cached_property
    def _places(self) -> tuple[Doubles, list[int]]:
        """Least number and size of each side."""
        columns = list(self._columns.places)
        if self._is_ordered:
            cells = [self._head.numbers(k)[: self._n_first] for k in columns]
            numbers = np.stack(cells, axis=1)
        else:
            numbers = np.concatenate(
                [part.numbers[:, columns] for part in self._rows()]
            )
        if not (np.isfinite(numbers) & (numbers == np.rint(numbers))).all():
            raise SourceError(f"{self._name}: places of taxels are no whole numbers")
        begins = numbers.min(axis=0)
        layout = self._head.layout
        stated: list[int | None] = [None]
        if len(columns) > 1:
            stated = [layout.n_rows, layout.n_cols]
        sizes = numbers.max(axis=0) - begins + 1
        pairs = zip(stated, sizes.tolist(), strict=True)
        return begins, [side or int(size) for side, size in pairs]

    def _pivoted(
        self, rows: Doubles, begins: npt.NDArray[np.intp], times: Sequence[int | float]
    ) -> Block:
        """Frames of lines, of which each of `begins` is the first of a frame."""
        counts = np.diff([*begins, len(rows)])
        frame = np.repeat(np.arange(len(begins)), counts)
        origin, sizes = self._places
        places = rows[:, list(self._columns.places)] - origin
        is_inside = ((places >= 0) & (places < sizes)).all(axis=1)
        if not is_inside.all():
            names = [axis.label for axis in self.axes]
            k = int(np.argmin(is_inside))
            pairs = zip(names, places[k], strict=True)
            text = ", ".join(f"{name} {number:g}" for name, number in pairs)
            fault = f"{text} is outside {' x '.join(map(str, sizes))}"
            raise SourceError(f"{self._name}: {fault}, as of the first frame")

        # Taxels that have no line in a frame are missing: not 0, which would be a force.
        shape = (len(begins), *sizes)
        if math.prod(shape) > MAX_SPARSE * len(rows):
            fault = f"{len(rows)} lines of {math.prod(shape)} taxels"
            raise SourceError(f"{self._name}: {fault}: most have no line")
        numbers = np.full(shape, np.nan)
        cells = np.ravel_multi_index((frame, *places.T.astype(np.intp)), shape)
        if np.unique(cells).size != len(rows):
            raise SourceError(f"{self._name}: a frame holds a taxel twice")
        numbers.flat[cells] = rows[:, self._columns.value]
        return Block(numbers, [times[k] for k in begins] if times else None)
