"""The frames of an array in a file of arrays, as a recording."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, islice
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Mask
from sparseskin.nodes.sensor.layout import times
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.checks import parse_number, shown
from sparseskin.nodes.sensor.layout.roles import (
    CHANNEL,
    FRAMES,
    label_role,
    roles_of,
)
from sparseskin.nodes.sensor.layout.tally import Tally

from .datasets import (
    F_MAX,
    FILL_VALUES,
    FORCES,
    MASK,
    NO_UNITS,
    OFFSET,
    PITCH,
    POINT_ROWS,
    POINTS,
    RATE,
    SCALE,
    UNIT,
    ArrayFile,
    frames_key,
    times_key,
    times_keys,
)
from .recording import Block, File, Head, Recording, frames_per_block
from .table.columns import time_of_rows

MAX_ROWS = 256
"""Longest side of a skin; chosen: mats and beds have up to 160 rows."""
MAX_PART = 3
"""Least length of the axis of the frames by that of a side; chosen: the other way round there would
be a recording of fewer frames than a third of its rows."""


class DatasetRecording(Recording):
    """The frames of an array, with times and properties from arrays beside it, or attributes.

    The array is that of `frames_key`, its axes are those of `roles_of`. Times are an array of one
    axis with a name of times and as long, or a column of a table. Optional are, as arrays in the
    same group or around it: `rate_hz`, `f_max`, `pitch_m`, one number each; `unit`, a text; `mask`,
    of the sides of a frame, True or 1 where a taxel exists; `points`, float32 of shape
    (n_taxels, 6): place in metres and unit normal of each taxel of a skin that is no flat grid;
    `point_rows`, int32 of shape (n_taxels,): their rows in a file of points. Raises SourceError if
    one of these is not as described, UnstatedError if several arrays, axes or times are possible.
    """

    def __init__(self, file: File, arrays: ArrayFile) -> None:
        self.tally = Tally("items of the array")
        self._layout = file.layout
        self._arrays = arrays
        self._key = frames_key(arrays, file.layout)
        self._where = arrays.where(self._key)
        self._dataset = arrays.datasets[self._key]
        self._attributes = self._dataset.attributes
        self._check_dataset()
        self._packing = self._packed()
        self._notes: list[str] = []
        #: The axis of the frames, None if the array is one; and the others.
        self._frame_axis: int | None = None
        self._items: list[Axis] = []
        #: The array of the times, "" if there is none, or their column in a table.
        self._time_key = ""
        self._time_column: int | None = None
        self._find_axes()
        self._find_time_column()

    def head(self) -> Head:
        usable = None
        is_timed = bool(self._time_key) or self._time_column is not None
        if len(self._items) == 1 and (
            self._time_column is not None or self._layout.columns
        ):
            columns = range(self._items[0].size)
            usable = tuple(k for k in columns if k != self._time_column)
        # The title may say which skin it is, which nothing else does.
        notes = list(self._notes)
        title = self._attributes.get("long_name")
        if title:
            notes.append(f"long name: {printable(text_of(title))[:60]}")
        return Head(
            tuple(self._items),
            usable,
            is_timed=is_timed,
            time_unit=self._time_unit(),
            time_name=self._time_key or f"column {(self._time_column or 0) + 1}",
            unit=self._unit(),
            rate_hz=self._rate(notes),
            f_max=self._number(F_MAX),
            pitch_m=self._number(PITCH),
            mask=self._mask(notes),
            points=self._beside(POINTS),
            point_rows=self._beside(POINT_ROWS),
            n_items=self._n_frames,
            notes=tuple(notes),
        )

    def blocks(self) -> Iterator[Block]:
        self.tally.begin()
        size = frames_per_block(math.prod(axis.size for axis in self._items))
        stamps = self._times(size)
        for numbers in self._numbers(size):
            n = len(numbers)
            block_times: Sequence[int | float] | None = None
            if self._time_column is not None:
                block_times = checked_times(numbers[:, self._time_column], self._where)
            elif self._time_key:
                block_times = list(islice(stamps, n))
            self.tally.take(n, n)
            yield Block(numbers, block_times)

    @property
    def _n_frames(self) -> int:
        if self._frame_axis is None:
            return 1
        return self._dataset.sides[self._frame_axis]

    def _numbers(self, size: int) -> Iterator[npt.NDArray[Any]]:
        """Blocks of at most `size` frames, (k, *sides of a frame)."""
        if self._frame_axis is None:
            blocks = iter([self._arrays.property_array(self._key)[np.newaxis]])
        else:
            blocks = self._arrays.blocks(self._key, self._frame_axis, size)
        for block in blocks:
            if block.dtype.kind == "b":
                block = block.view(np.uint8)
            for begin in range(0, len(block), size):
                part = block[begin : begin + size]
                if self._packing:
                    part = self._unpacked(part)
                yield part

    def _unpacked(self, numbers: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Numbers as the attributes of their array state them: NaN for its fill value, times its
        scale, plus its offset. Source: CF conventions, sections 2.5 and 8.1.
        """
        # Fill values are those of the stored numbers, before they are scaled.
        values = numbers.astype(np.float64)
        for name in FILL_VALUES:
            if name in self._packing:
                values[numbers == self._packing[name]] = np.nan
        return values * self._packing.get(SCALE, 1.0) + self._packing.get(OFFSET, 0.0)

    def _packed(self) -> dict[str, float]:
        """The attributes of the array that state what its numbers stand for."""
        packing = {}
        for name in (SCALE, OFFSET, *FILL_VALUES):
            number = number_of(self._attributes.get(name))
            if number is not None and math.isfinite(number):
                packing[name] = number
        return packing

    def _times(self, size: int) -> Iterator[int | float]:
        """The times of all frames, one after the other, from an array of their own."""
        if not self._time_key:
            return iter(())
        sides = self._arrays.datasets[self._time_key].sides
        blocks = self._arrays.blocks(self._time_key, sides.index(max(sides)), size)
        where = self._arrays.where(self._time_key)
        return chain.from_iterable(
            checked_times(block.reshape(-1), where) for block in blocks
        )

    def _check_dataset(self) -> None:
        """Raise SourceError unless the array holds numbers, of two axes or more."""
        dataset = self._dataset
        if dataset.dtype.kind not in "iufb":
            kind = f"dtype {dataset.dtype}"
            if dataset.dtype.hasobject:
                kind = "Python objects"
            allowed = "allowed are integers, floating point and bool"
            raise SourceError(f"{self._where}: holds {kind[:60]}; {allowed}")
        if len(dataset.sides) < 2:
            fault = f"has {len(dataset.sides)} axes, {dataset.text}"
            expected = "expected frames, rows and columns, or frames and readings"
            raise SourceError(f"{self._where}: {fault}; {expected}")

    def _find_axes(self) -> None:
        """Find the axis of the frames, and the array of their times."""
        arrays = self._arrays
        # Times are found first: their number shows which axis is that of the frames.
        keys = times_keys(arrays, self._layout)
        n_times = {math.prod(arrays.datasets[key].sides) for key in keys}
        axes = arrays.axes(self._key)
        roles, is_guess = roles_of(
            self._layout, axes, self._where, True, n_times, self._frames_are_first
        )
        for at, (role, axis) in enumerate(zip(roles, axes, strict=True)):
            if role == FRAMES:
                self._frame_axis = at
            else:
                # A label that states the role may state more, as xyz.
                label = role
                if label_role(axis) == role:
                    label = axis.label
                self._items.append(axis._replace(label=label))

        about = f"{self._dataset.text}: axes {','.join(roles)}"
        if self._key:
            about = f"array {printable(self._key)}, {about}"
        if is_guess:
            about += ", the first one as is usual"
        self._notes += [about, *arrays.notes]
        self._time_key, time_notes = times_key(
            arrays, self._layout, self._key, keys, self._n_frames
        )
        self._notes += time_notes
        if self._packing:
            texts = [f"{name} = {value:g}" for name, value in self._packing.items()]
            self._notes.append(f"its numbers are read with {', '.join(texts)}")
        if self._dataset.dtype.kind == "b":
            self._notes.append("True and False are read as 1 and 0")

    def _frames_are_first(self) -> bool:
        """True if the first axis is that of the frames, as most programs write them: it is longer
        than any side of a skin, or many times the others, or these are a square.
        """
        arrays = self._arrays
        axes = arrays.axes(self._key)
        if not arrays.has_frames_first:
            return False
        # This program writes its own frames so.
        if arrays.last_part(self._key) == FORCES:
            return True
        n_first, *sizes = [axis.size for axis in axes]
        sides = {size for size in sizes if size > 1}
        if n_first == 1:
            return False
        # One side, or a square: frames along another axis would be as many as its rows.
        if len(sides) < 2 and len(axes) < 4 and n_first not in sides:
            return True
        is_stated = bool(self._layout.axes) or self._layout.n_stated is not None
        n_least = MAX_PART
        if is_stated:
            n_least = 1
        return n_first > n_least * max(sides) or n_first >= MAX_ROWS > max(sides)

    def _find_time_column(self) -> None:
        """Find the column of a table that holds the times, as in a table of text. Raises
        UnstatedError if a column may be the times.
        """
        layout = self._layout
        is_row = len(self._items) == 1 and self._frame_axis is not None
        if layout.has_time_column and not is_row:
            fault = f"time = {layout.time}, but a frame is no row of numbers"
            ways = "state none, or the name of an array"
            raise SourceError(f"{self._where}: {fault}; {ways}")
        is_decided = self._time_key or layout.time or layout.columns
        if not is_row or (is_decided and not layout.has_time_column):
            return
        (axis,) = self._items
        # All columns are taxels, if the shape needs as many.
        if axis.size < 2 or layout.n_stated == axis.size:
            return
        begin = next(self._numbers(frames_per_block(axis.size)), None)
        if begin is not None:
            self._time_column, notes = time_of_rows(
                axis.names, begin, layout, self._where
            )
            self._notes += notes

    def _beside(self, name: str) -> npt.NDArray[Any] | None:
        """The array of a property."""
        path = self._arrays.nearest(self._key, name)
        if not path:
            return None
        return self._arrays.property_array(path)

    def _number(self, name: str) -> float | None:
        """A number above 0, of an array of its own or an attribute."""
        value: Any = self._beside(name)
        where = self._arrays.where(self._arrays.nearest(self._key, name))
        if value is None:
            value = self._attributes.get(name)
            where = f"{self._where}, attribute {name!r}"
        if value is None:
            return None
        number = number_of(value)
        if number is None:
            raise SourceError(f"{where}: expected one number")
        number = parse_number(str(number), where)
        if number <= 0:
            raise SourceError(f"{where}: {number:g} must be above 0")
        return number

    def _rate(self, notes: list[str]) -> float | None:
        """Frames per second that the file states, by the first of their names."""
        # The name of this program's own files comes before those of others.
        rate_hz = self._number(RATE)
        if rate_hz is not None:
            return rate_hz
        by_name: dict[str, float] = {}
        for name, value in self._values_beside():
            rate_hz = times.rate_of(name, number_of(value) or 0.0)
            if rate_hz:
                by_name[name] = rate_hz
        rates = ", ".join(f"{name} = {rate:g}" for name, rate in by_name.items())
        if len(set(by_name.values())) > 1:
            notes.append(f"{rates}: more than one rate is stated, and none is used")
        elif by_name:
            notes.append(f"the rate is that of {rates} Hz")
            return next(iter(by_name.values()))
        return None

    def _values_beside(self) -> Iterator[tuple[str, Any]]:
        """Names and values that may state the rate: attributes, and single numbers in the group of
        the array or around it.
        """
        names = {name.lower(): name for name in self._attributes}
        for name in names.values():
            yield name, self._attributes[name]
        for path, dataset in self._arrays.datasets.items():
            name = self._arrays.last_part(path)
            is_nearest = self._arrays.nearest(self._key, name) == path
            is_single = is_nearest and math.prod(dataset.sides) == 1
            if is_single and times.rate_of(name, 1.0):
                yield name, self._arrays.whole(path)

    def _unit(self) -> str | None:
        unit = self._beside(UNIT)
        if unit is not None:
            if unit.size != 1 or unit.dtype.kind not in "US":
                where = self._arrays.where(self._arrays.nearest(self._key, UNIT))
                raise SourceError(f"{where}: expected one text, e.g. np.array('N')")
            return text_of(unit)
        text = unit_text(self._attributes)
        if text.lower() in NO_UNITS:
            return None
        return text

    def _time_unit(self) -> str:
        """Unit of the times as the file states it, "" where it does not."""
        if not self._time_key:
            return ""
        dataset = self._arrays.datasets[self._time_key]
        if dataset.dtype.kind in "Mm":
            return "ns"
        if dataset.dtype.kind in "US":
            long_axis = dataset.sides.index(max(dataset.sides))
            begin = next(self._arrays.blocks(self._time_key, long_axis, 1))
            if times.iso_ns(text_of(begin.reshape(-1)[0])) is not None:
                return times.ISO
            return times.CLOCK_UNIT

        # As "seconds since 2026-03-12": the unit comes first.
        word = unit_text(dataset.attributes).lower().partition(" ")[0]
        if word in NO_UNITS or self._layout.time_unit:
            return times.named_unit(self._arrays.last_part(self._time_key))
        unit = times.named_unit(f"_{word}")
        if not unit:
            where = self._arrays.where(self._time_key)
            fault = f"its unit is {shown(word)}, none of ns, us, ms, s"
            raise SourceError(f"{where}: {fault}; state time_unit, or time=none")
        return unit

    def _mask(self, notes: list[str]) -> Mask | None:
        """The mask of the numbers of a frame, of its sides."""
        path = self._arrays.nearest(self._key, MASK)
        if not path:
            return None
        where = self._arrays.where(path)
        dataset = self._arrays.datasets[path]
        # A taxel exists, or not, with all of its channels.
        sizes = [
            1 if label_role(axis) == CHANNEL else axis.size for axis in self._items
        ]
        sides = tuple(size for size in sizes if size > 1)
        if self._time_column is not None:
            sides = (sides[0] - 1,)
        forms: list[npt.NDArray[Any]] = []
        if math.prod(dataset.sides) == math.prod(sides):
            mask = self._arrays.property_array(path).squeeze()
            # Of a frame that is a list of taxels, the mask may be a grid.
            order: Literal["C", "F"] = "C"
            if self._layout.order == "columns":
                order = "F"
            forms = [mask, mask.T, mask.ravel(order)]
        exists = next((form for form in forms if form.shape == sides), None)
        if exists is None:
            # Beside another program's array "mask" may be anything; beside ours it is one.
            if self._arrays.last_part(self._key) != FORCES:
                notes.append(f"array {printable(path)} is no mask of a frame: not read")
                return None
            fault = f"is {dataset.text}, but a frame {' x '.join(map(str, sides))}"
            raise SourceError(f"{where}: {fault}")
        if exists.dtype.kind not in "biu" or not np.isin(exists, (0, 1)).all():
            fault = "expected bool (True where a taxel exists), or 0 and 1"
            raise SourceError(f"{where}: {fault}")
        if self._time_column is not None:
            exists = np.insert(exists, self._time_column, 1)
        item_sides = [axis.size for axis in self._items]
        whole = np.broadcast_to(exists.reshape(sizes), item_sides)
        return whole.astype(np.bool_)


def number_of(value: Any) -> float | None:
    """The number of an attribute, or of an array of one; None if it is none."""
    array = np.asarray(value)
    if array.size != 1 or array.dtype.kind not in "iuf":
        return None
    return float(array.reshape(())[()])


def unit_text(attributes: Mapping[str, Any]) -> str:
    """The unit that attributes state, "" if none."""
    return text_of(attributes.get(UNIT, attributes.get("units", ""))).strip()


def text_of(value: object) -> str:
    """A text of a file: bytes are decoded, anything else is written out."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(())[()]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return str(value)


def checked_times(numbers: npt.NDArray[Any], where: str) -> list[int | float]:
    """Times as Python's own numbers: whole ones as they are, dates in nanoseconds since 1970, texts
    of ISO 8601 or times of day in nanoseconds. Raises SourceError if one is none.
    """
    kind = numbers.dtype.kind
    if kind in "Mm":
        unit = "timedelta64[ns]"
        if kind == "M":
            unit = "datetime64[ns]"
        if np.isnat(numbers).any():
            raise SourceError(f"{where}: a time is missing (NaT)")
        numbers = numbers.astype(unit).astype(np.int64)
    elif kind in "US":
        return [_text_time(text_of(text), where) for text in numbers.tolist()]
    elif kind == "f" and not np.isfinite(numbers).all():
        raise SourceError(f"{where}: a time is not a finite number")
    whole: list[int | float] = numbers.tolist()
    return whole


def _text_time(text: str, where: str) -> int:
    stamp = times.iso_ns(text.strip())
    if stamp is None:
        stamp = times.clock_ns(text.strip())
    if stamp is None:
        raise SourceError(
            f"{where}: {shown(text)} is no time, as 2026-11-03T10:15:02.120"
        )
    return stamp
