"""The frames of an array in a file of arrays, as a recording."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import chain, islice
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Mask
from sparseskin.nodes.sensor.layout import times
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.checks import parse_number, shown
from sparseskin.nodes.sensor.layout.roles import CHANNEL, FRAMES, label_role, roles_of
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


class _Plan(NamedTuple):
    """Places of the frames and of their times."""

    key: str
    frame_axis: int | None  # None: the array is one frame
    items: tuple[Axis, ...]  # the other axes, with their roles as labels
    time_key: str  # "": none
    time_column: int | None  # of the frames themselves
    notes: tuple[str, ...]


class DatasetRecording(Recording):
    """The frames of an array, with times and properties from arrays beside it, or attributes.

    The array is that of `frames_key`, its axes are those of `roles_of`. Times are an
    array of one axis with a name of times and as long, or a column of a table. Optional are, as
    arrays in the same group or around it: `rate_hz`, `f_max`, `pitch_m`, one number each; `unit`, a
    text; `mask`, of the sides of a frame, True or 1 where a taxel exists; `points`, float32 of
    shape (n_taxels, 6): place in metres and unit normal of each taxel of a skin that is no flat
    grid; `point_rows`, int32 of shape (n_taxels,): their rows in a file of points. Raises
    SourceError if one of these is not as described, UnstatedError if several arrays, axes or times
    are possible.
    """

    def __init__(self, file: File, arrays: ArrayFile) -> None:
        self.tally = Tally("items of the array")
        self._layout = file.layout
        self._arrays = arrays

    def head(self) -> Head:
        return self._head

    def blocks(self) -> Iterator[Block]:
        plan = self._plan
        self.tally.begin()
        size = frames_per_block(math.prod(axis.size for axis in plan.items))
        stamps = self._times(plan, size)
        for numbers in self._numbers(plan, size):
            n = len(numbers)
            block_times: Sequence[int | float] | None = None
            if plan.time_column is not None:
                column = numbers[:, plan.time_column]
                block_times = checked_times(column, self._arrays.where(plan.key))
            elif plan.time_key:
                block_times = list(islice(stamps, n))
            self.tally.take(n, n)
            yield Block(numbers, block_times)

    def _numbers(self, plan: _Plan, size: int) -> Iterator[npt.NDArray[Any]]:
        """Blocks of at most `size` frames, (k, *sides of a frame)."""
        if plan.frame_axis is None:
            blocks = iter([self._arrays.property_array(plan.key)[np.newaxis]])
        else:
            blocks = self._arrays.blocks(plan.key, plan.frame_axis, size)
        packing = self._packing(plan.key)
        for block in blocks:
            if block.dtype.kind == "b":
                block = block.view(np.uint8)
            for begin in range(0, len(block), size):
                part = block[begin : begin + size]
                yield self._unpacked(part, packing) if packing else part

    @staticmethod
    def _unpacked(
        numbers: npt.NDArray[Any], packing: Mapping[str, float]
    ) -> npt.NDArray[Any]:
        """Numbers as the attributes of their array state them: NaN for its fill value, times its
        scale, plus its offset. Source: CF conventions, sections 2.5 and 8.1.
        """
        values = numbers.astype(np.float64)
        for name in FILL_VALUES:
            if name in packing:
                values[numbers == packing[name]] = np.nan
        return values * packing.get(SCALE, 1.0) + packing.get(OFFSET, 0.0)

    def _packing(self, key: str) -> dict[str, float]:
        """The attributes of an array that state what its numbers stand for."""
        attributes = self._arrays.datasets[key].attributes
        packing = {}
        for name in (SCALE, OFFSET, *FILL_VALUES):
            value = np.asarray(attributes.get(name, np.nan))
            if (
                value.size == 1
                and value.dtype.kind in "iuf"
                and np.isfinite(value).all()
            ):
                packing[name] = float(value.reshape(()))
        return packing

    def _times(self, plan: _Plan, size: int) -> Iterator[int | float]:
        """The times of all frames, one after the other, from an array of their own."""
        if not plan.time_key:
            return iter(())
        sides = self._arrays.datasets[plan.time_key].sides
        blocks = self._arrays.blocks(plan.time_key, sides.index(max(sides)), size)
        where = self._arrays.where(plan.time_key)
        return chain.from_iterable(
            checked_times(block.reshape(-1), where) for block in blocks
        )

    @cached_property
    def _plan(self) -> _Plan:
        """Where everything is. Raises SourceError, UnstatedError."""
        arrays = self._arrays
        layout = self._layout
        key = frames_key(arrays, layout)
        self._check_dataset(key)
        dataset = arrays.datasets[key]

        # Times are found first: their number shows which axis is that of the frames.
        keys = times_keys(arrays, layout)
        n_times = {math.prod(arrays.datasets[name].sides) for name in keys}
        first_is_usual: bool | None = arrays.has_frames_first
        if first_is_usual and arrays.last_part(key) == FORCES:
            first_is_usual = None
        axes = arrays.axes(key)
        where = arrays.where(key)
        roles, is_guess = roles_of(layout, axes, where, True, n_times, first_is_usual)
        items = []
        n_frames = 1
        frame_axis = None
        for at, (role, axis) in enumerate(zip(roles, axes, strict=True)):
            if role == FRAMES:
                frame_axis = at
                n_frames = axis.size
            else:
                # A label that states the role may state more, as xyz.
                label = axis.label if label_role(axis) == role else role
                items.append(axis._replace(label=label))
        time_key, time_notes = times_key(arrays, layout, key, keys, n_frames)

        about = f"{dataset.text}: axes {','.join(roles)}"
        if key:
            about = f"array {printable(key)}, {about}"
        if is_guess:
            about += ", the first one as is usual"
        notes = [about, *arrays.notes, *time_notes]
        packing = self._packing(key)
        if packing:
            text = ", ".join(f"{name} = {value:g}" for name, value in packing.items())
            notes.append(f"its numbers are read with {text}")
        if dataset.dtype.kind == "b":
            notes.append("True and False are read as 1 and 0")
        plan = _Plan(key, frame_axis, tuple(items), time_key, None, tuple(notes))
        return self._with_time_column(plan)

    def _check_dataset(self, key: str) -> None:
        """Raise SourceError unless an array holds numbers, of two axes or more."""
        dataset = self._arrays.datasets[key]
        where = self._arrays.where(key)
        if dataset.dtype.kind not in "iufb":
            kind = f"dtype {dataset.dtype}"
            if dataset.dtype.hasobject:
                kind = "Python objects"
            allowed = "allowed are integers, floating point and bool"
            raise SourceError(f"{where}: holds {kind[:60]}; {allowed}")
        if len(dataset.sides) < 2:
            fault = f"has {len(dataset.sides)} axes, {dataset.text}"
            expected = "expected frames, rows and columns, or frames and readings"
            raise SourceError(f"{where}: {fault}; {expected}")

    def _with_time_column(self, plan: _Plan) -> _Plan:
        """With the column of a table that holds the times, as in a table of text. Raises
        UnstatedError if a column may be the times.
        """
        layout = self._layout
        items = plan.items
        where = self._arrays.where(plan.key)
        is_stated = layout.has_time_column
        is_row = len(items) == 1 and plan.frame_axis is not None
        if is_stated and not is_row:
            fault = f"time = {layout.time}, but a frame is no row of numbers"
            raise SourceError(f"{where}: {fault}; state none, or the name of an array")
        is_open = is_stated or not (plan.time_key or layout.time or layout.columns)
        if not (is_row and is_open) or layout.n_stated == items[0].size:
            return plan
        (axis,) = items
        begin = next(self._numbers(plan, frames_per_block(axis.size)), None)
        if begin is None or axis.size < 2:
            return plan
        column, notes = time_of_rows(axis.names, begin, layout, where)
        return plan._replace(time_column=column, notes=(*plan.notes, *notes))

    @cached_property
    def _head(self) -> Head:
        plan = self._plan
        dataset = self._arrays.datasets[plan.key]
        items = plan.items
        usable = None
        if len(items) == 1 and (plan.time_column is not None or self._layout.columns):
            usable = tuple(k for k in range(items[0].size) if k != plan.time_column)
        unit = self._unit(plan)
        time_unit = self._time_unit(plan)
        mask, mask_notes = self._mask(plan)
        rate_hz, rate_notes = self._rate(plan)
        long_name = dataset.attributes.get("long_name")
        title: tuple[str, ...] = ()
        if long_name:
            title = (f"long name: {printable(text_of(long_name))[:60]}",)
        n_items = 1
        if plan.frame_axis is not None:
            n_items = dataset.sides[plan.frame_axis]
        return Head(
            items,
            usable,
            is_timed=bool(plan.time_key) or plan.time_column is not None,
            time_unit=time_unit,
            time_name=plan.time_key or f"column {(plan.time_column or 0) + 1}",
            unit=unit,
            rate_hz=rate_hz,
            f_max=self._number(plan.key, F_MAX),
            pitch_m=self._number(plan.key, PITCH),
            mask=mask,
            points=self._array(plan.key, POINTS),
            point_rows=self._array(plan.key, POINT_ROWS),
            n_items=n_items,
            notes=(*plan.notes, *title, *rate_notes, *mask_notes),
        )

    def _array(self, key: str, name: str) -> npt.NDArray[Any] | None:
        path = self._arrays.nearest(key, (name,))
        if not path:
            return None
        return self._arrays.property_array(path)

    def _number(self, key: str, name: str) -> float | None:
        """A number above 0, of an array of its own or an attribute."""
        path = self._arrays.nearest(key, (name,))
        value = self._arrays.datasets[key].attributes.get(name)
        where = f"{self._arrays.where(key)}, attribute {name!r}"
        if path:
            value = self._arrays.property_array(path)
            where = self._arrays.where(path)
        if value is None:
            return None
        array = np.asarray(value)
        if array.size != 1 or array.dtype.kind not in "iuf":
            raise SourceError(f"{where}: expected one number")
        number = parse_number(str(array.reshape(())[()]), where)
        if number <= 0:
            raise SourceError(f"{where}: {number:g} must be above 0")
        return number

    def _rate(self, plan: _Plan) -> tuple[float | None, tuple[str, ...]]:
        """Frames per second that the file states, by the first of their names."""
        rate_hz = self._number(plan.key, RATE)
        if rate_hz is not None:
            return rate_hz, ()
        by_name: dict[str, float] = {}
        for name, value in self._values_beside(plan.key):
            array = np.asarray(value)
            if array.size != 1 or array.dtype.kind not in "iuf":
                continue
            number = float(array.reshape(()))
            rate_of_name = times.rate_of(name, number)
            if rate_of_name:
                by_name[name] = rate_of_name
        rates = ", ".join(f"{name} = {rate:g}" for name, rate in by_name.items())
        if len(set(by_name.values())) > 1:
            return None, (f"{rates}: more than one rate is stated, and none is used",)
        if by_name:
            return next(iter(by_name.values())), (f"the rate is that of {rates} Hz",)
        return None, ()

    def _values_beside(self, key: str) -> Iterator[tuple[str, Any]]:
        """Names and values that may state the rate of an array: attributes, and single numbers in
        its group or around it.
        """
        arrays = self._arrays
        names = {name.lower(): name for name in arrays.datasets[key].attributes}
        for name in names.values():
            yield name, arrays.datasets[key].attributes[name]
        for path, dataset in arrays.datasets.items():
            name = arrays.last_part(path)
            is_nearest = arrays.nearest(key, (name,)) == path
            if (
                is_nearest
                and math.prod(dataset.sides) == 1
                and times.rate_of(name, 1.0)
            ):
                yield name, arrays.whole(path)

    def _unit(self, plan: _Plan) -> str | None:
        path = self._arrays.nearest(plan.key, (UNIT,))
        if path:
            where = self._arrays.where(path)
            unit = self._arrays.property_array(path)
            if unit.size != 1 or unit.dtype.kind not in "US":
                raise SourceError(f"{where}: expected one text, e.g. np.array('N')")
            return text_of(unit.reshape(())[()])
        attributes = self._arrays.datasets[plan.key].attributes
        unit_text = text_of(attributes.get(UNIT, attributes.get("units", ""))).strip()
        if unit_text.lower() in NO_UNITS:
            return None
        return unit_text

    def _time_unit(self, plan: _Plan) -> str:
        """Unit of the times as the file states it, "" where it does not."""
        if not plan.time_key:
            return ""
        dataset = self._arrays.datasets[plan.time_key]
        where = self._arrays.where(plan.time_key)
        if dataset.dtype.kind in "Mm":
            return "ns"
        if dataset.dtype.kind in "US":
            long_axis = dataset.sides.index(max(dataset.sides))
            begin = next(self._arrays.blocks(plan.time_key, long_axis, 1))
            if times.iso_ns(text_of(begin.reshape(-1)[0])) is not None:
                return times.ISO
            return times.CLOCK_UNIT

        # As "seconds since 2026-03-12": the unit comes first.
        attributes = dataset.attributes
        words = (
            text_of(attributes.get("units", attributes.get(UNIT, ""))).lower().split()
        )
        word = words[0] if words else ""
        if word in NO_UNITS or self._layout.time_unit:
            return times.named_unit(self._arrays.last_part(plan.time_key))
        unit = times.named_unit(f"_{word}")
        if not unit:
            ways = "state time_unit, or time=none"
            raise SourceError(
                f"{where}: its unit is {shown(word)}, none of ns, us, ms, s; {ways}"
            )
        return unit

    def _mask(self, plan: _Plan) -> tuple[Mask | None, tuple[str, ...]]:
        """The mask of the numbers of a frame, of its sides, and what is to be said where an array
        named `mask` is none of a frame.
        """
        path = self._arrays.nearest(plan.key, (MASK,))
        if not path:
            return None, ()
        where = self._arrays.where(path)
        dataset = self._arrays.datasets[path]
        items = plan.items
        # A taxel exists, or not, with all of its channels.
        mask_sides = [1 if label_role(axis) == CHANNEL else axis.size for axis in items]
        sides = tuple(side for side in mask_sides if side > 1)
        if plan.time_column is not None:
            sides = (sides[0] - 1,)

        forms: list[npt.NDArray[Any]] = []
        if math.prod(dataset.sides) == math.prod(sides):
            mask = self._arrays.property_array(path).squeeze()
            # Of a frame that is a list of taxels, the mask may be a grid.
            order: Literal["C", "F"] = "F" if self._layout.order == "columns" else "C"
            forms = [mask, mask.T, mask.ravel(order)]
        fitting = [form for form in forms if form.shape == sides]
        if not fitting:
            if self._arrays.last_part(plan.key) != FORCES:
                note = f"array {printable(path)} is no mask of a frame: not read"
                return None, (note,)
            fault = f"is {dataset.text}, but a frame {' x '.join(map(str, sides))}"
            raise SourceError(f"{where}: {fault}")
        exists = fitting[0]
        if exists.dtype.kind not in "biu" or not np.isin(exists, (0, 1)).all():
            raise SourceError(
                f"{where}: expected bool (True where a taxel exists), or 0 and 1"
            )
        if plan.time_column is not None:
            exists = np.insert(exists, plan.time_column, 1)
        item_sides = [axis.size for axis in items]
        whole = np.broadcast_to(exists.reshape(mask_sides), item_sides)
        return whole.astype(np.bool_), ()


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
        unit = "datetime64[ns]" if kind == "M" else "timedelta64[ns]"
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
