"""The axis of the frames in an array, and what its other axes are."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout.arrangement import (
    CHANNELS,
    COLS,
    ROWS,
    Axis,
    may_hold_channel,
)
from sparseskin.nodes.sensor.layout.layout import Layout, UnstatedError

FRAME_LABELS = frozenset(
    {"frame", "frames", "n_frames", "time", "times", "t", "timestamp", "timestamps"}
    | {"sample", "samples", "step", "steps"}
)
"""Labels of the axis of the frames."""
TAXEL_LABELS = frozenset(
    {*ROWS, *COLS, *CHANNELS, "taxel", "taxels", "sensor", "sensors"}
)
_DIRECT = 0
_WITH_TIME = 1
_MIDDLE = 1
_TRANSPOSED = 2
_CHANNELS = 4
_NO_FIT = 8
"""Fits of a frame and the stated shape, the better the smaller: as it is; with one number too many,
which may be the time; with columns before rows. `_CHANNELS` is added where an axis has to be that
of the channels, though no channel is stated, `_MIDDLE` where these stand between rows and columns:
no program writes them so."""
CHANNEL = "channel"
ENDS = ("first", "last")
"""Columns of times, beside numbers."""


class FrameAxis(NamedTuple):
    """The axis along which the frames follow each other, None where the whole array is one frame;
    the others in their order; and by what it is known, for the log.
    """

    axis: int | None
    items: tuple[Axis, ...]
    reason: str


class ArrayShape(NamedTuple):
    """Sides of an array, labels of its axes ("" for none), its place for errors, and names of the
    entries of axes.
    """

    sides: tuple[int, ...]
    labels: tuple[str, ...]
    where: str
    names: Mapping[int, tuple[str, ...]] = MappingProxyType({})

    @property
    def text(self) -> str:
        return " x ".join(map(str, self.sides))

    def others(self, axis: int | None) -> list[int]:
        """The axes beside that of the frames."""
        return [at for at in range(len(self.sides)) if at != axis]


def has_time_column(layout: Layout) -> bool:
    """True if the times are stated to be a column of the readings."""
    return layout.time in ENDS or layout.time.isdecimal()


def can_be_frames(layout: Layout, array: ArrayShape) -> bool:
    """True if some axis of an array leaves frames of the stated shape, if any is stated."""
    axes = [*range(len(array.sides)), None]
    return any(_best_way(layout, array, axis).fit != _NO_FIT for axis in axes)


class _Way(NamedTuple):
    """A possible axis of the frames, and how the others are a frame of the stated shape."""

    axis: int | None
    fit: int
    channel: int | None  # the axis that is no row and no column


def find_frame_axis(
    layout: Layout,
    array: ArrayShape,
    n_times: Collection[int],
    first_is_usual: bool | None,
    items_are_named: bool = False,
) -> FrameAxis:
    """The axis of the frames; with `items_are_named` the others are stated.

    In this order: as it is stated; as the labels of the file say; the only one as long as times
    beside the array (`n_times`), and that leaves the stated shape, of which rows and columns are
    transposed where nothing else fits; and then the first one, where that is usual: where it is the
    longest, or the others are a square, or `first_is_usual` is None. Raises SourceError if what is
    stated does not fit the array, UnstatedError with the possible ways if there are several.
    """
    names = layout.axis_names
    n_long = sum(side > 1 for side in array.sides)
    # Names of the other axes alone say nothing of that of the frames.
    if names and "frames" not in names and len(names) == n_long - 1:
        without_axes = layout.stating({"axes": ""})
        frame_axis = find_frame_axis(
            without_axes, array, n_times, first_is_usual, items_are_named=True
        )
        return _with_items(names, frame_axis)

    stated_labels = _stated_labels(names, array)
    labels = stated_labels or array.labels
    array = array._replace(labels=labels)
    ways = _labelled(labels, is_stated=bool(stated_labels))
    if ways is not None and len(ways) == 1:
        (axis,) = ways
        reason = "as stated" if stated_labels else "by its label"
    else:
        candidates = range(len(array.sides)) if ways is None else ways
        fitting = _fitting(layout, array, candidates, n_times)
        axis, reason = _decided(layout, array, fitting, n_times, first_is_usual)
    way = _best_way(layout, array, axis)
    _ask_for_channel(layout, array, way)
    if not items_are_named:
        _ask_for_one(layout, array, axis)
    return FrameAxis(axis, tuple(_items(array, way)), reason + _said(way))


def _with_items(names: Sequence[str], frame_axis: FrameAxis) -> FrameAxis:
    """The same with stated names of the axes beside that of the frames."""
    remaining = iter(names)
    items = []
    for axis in frame_axis.items:
        # Axes of one entry have no name.
        label = next(remaining, "") if axis.size > 1 else ""
        items.append(Axis(axis.size, label))
    return frame_axis._replace(items=tuple(items))


def _stated_labels(names: Sequence[str], array: ArrayShape) -> tuple[str, ...]:
    """One label for each axis; () where none are stated. Axes of one entry may be left out, and so
    may the frames.
    """
    if not names:
        return ()
    sides = array.sides

    long_axes = [at for at, side in enumerate(sides) if side > 1]
    wrong = f"{array.where}: axes = {','.join(names)}, but the array is {array.text}"
    if len(names) == len(sides):
        labels = list(names)
    elif len(names) == len(long_axes):
        labels = ["-"] * len(sides)
        for at, name in zip(long_axes, names, strict=True):
            labels[at] = name
    else:
        raise SourceError(f"{wrong}; state each of its {len(sides)} axes")
    for at, name in enumerate(labels):
        if name == "-" and sides[at] != 1:
            raise SourceError(
                f"{wrong}: axis {at + 1} has {sides[at]} entries, - stands for one"
            )
        if name != "-" and labels.count(name) > 1:
            raise SourceError(f"{wrong}: {name} is stated twice")
    return tuple(labels)


def _labelled(labels: Sequence[str], is_stated: bool) -> list[int | None] | None:
    """The axes that can be the frames by their labels; None where these say nothing."""
    words = [label.lower() for label in labels]
    frames: list[int | None] = [
        at for at, word in enumerate(words) if word in FRAME_LABELS
    ]
    if frames:
        return frames
    if is_stated:
        return [None]
    unlabelled: list[int | None] = [
        at for at, word in enumerate(words) if word not in TAXEL_LABELS
    ]
    if 0 < len(unlabelled) < len(words):
        return unlabelled
    return None


def _ask_for_channel(layout: Layout, array: ArrayShape, way: _Way) -> None:
    """Raise UnstatedError if another axis can be that of the channels as well."""
    equal = [w for w in _ways(layout, array, way.axis) if w.fit == way.fit]
    if way.channel is None or len(equal) < 2:
        return
    fault = f"which axis of {array.text} is that of the channels is not stated"
    ways = [_axes_text(array, w) for w in equal]
    raise UnstatedError.between(f"{array.where}: {fault}", "axes", ways)


def _ask_for_one(layout: Layout, array: ArrayShape, axis: int | None) -> None:
    """Raise UnstatedError if 1 x 4 x 3 numbers may be a grid, or three numbers of 1 x 4 taxels."""
    items = array.others(axis)
    long_axes = [at for at in items if array.sides[at] > 1]
    is_stated = (
        layout.channel or layout.n_stated or any(array.labels[at] for at in items)
    )
    if len(items) != 3 or len(long_axes) != 2 or is_stated:
        return
    # As many as the axes of a force.
    at_end = [at for at in (items[0], items[-1]) if array.sides[at] == 3]
    if at_end:
        ways = [_Way(axis, _DIRECT, None), _Way(axis, _DIRECT, at_end[-1])]
        fault = f"{array.where}: {array.text} has one number per taxel, or three"
        texts = [_axes_text(array, way) for way in ways]
        raise UnstatedError.between(fault, "axes", texts, "n_rows and n_cols")


def _best_way(layout: Layout, array: ArrayShape, axis: int | None) -> _Way:
    """The best of the ways."""
    return min(_ways(layout, array, axis), key=lambda way: way.fit)


def _ways(layout: Layout, array: ArrayShape, axis: int | None) -> list[_Way]:
    """How the axes beside that of the frames are a frame, in order of preference."""
    sides = array.sides
    item_axes = [at for at in array.others(axis) if sides[at] > 1]
    if any(array.labels[at].lower() in TAXEL_LABELS for at in item_axes):
        # The arrangement follows the labels, and compares the stated shape with them.
        return [_Way(axis, _DIRECT, None)]

    ways: list[_Way] = []
    if len(item_axes) > 2 or layout.channel:
        extra = _DIRECT if layout.channel else _CHANNELS
        for channel in reversed(item_axes):
            if not may_hold_channel(layout.channel, sides[channel]):
                continue
            grid = [sides[at] for at in item_axes if at != channel]
            stated_channel = channel if layout.n_stated else None
            between = _MIDDLE if channel in item_axes[1:-1] else 0
            for fit in _fits(layout, grid):
                ways.append(_Way(axis, extra + between + fit, stated_channel))
    grid = [sides[at] for at in item_axes]
    for fit in _fits(layout, grid):
        ways.append(_Way(axis, _DIRECT + fit, None))
    return ways or [_Way(axis, _NO_FIT, None)]


def _fits(layout: Layout, sides: Sequence[int]) -> Iterator[int]:
    """The ways in which sides are those of a frame of the stated shape."""
    rows = layout.n_rows
    cols = layout.n_cols
    if len(sides) < 2:
        n = math.prod(sides)
        n_taxels = layout.n_stated
        has_columns = layout.columns or has_time_column(layout)
        if n_taxels is None:
            # Rows alone, or columns alone, have to divide the readings.
            if has_columns or n % (rows or cols or 1) == 0:
                yield _DIRECT
        elif n == n_taxels or (has_columns and n > n_taxels):
            yield _DIRECT
        elif n == n_taxels + 1:
            yield _WITH_TIME
    elif len(sides) == 2:
        outer, inner = sides
        if outer == (rows or outer) and inner == (cols or inner):
            yield _DIRECT
        elif inner == (rows or inner) and outer == (cols or outer):
            yield _TRANSPOSED


def _fitting(
    layout: Layout,
    array: ArrayShape,
    axes: Collection[int | None],
    n_times: Collection[int],
) -> list[int | None]:
    """Those axes that fit best what is stated, and times beside the array."""
    if not (layout.n_rows or layout.n_cols):
        long_axes = [
            at for at in axes if at is not None and (at == 0 or array.sides[at] > 1)
        ]
        as_long: list[int | None] = [
            at for at in long_axes if array.sides[at] in n_times
        ]
        return as_long or [*long_axes]
    shape = (
        f"{layout.n_rows or 'any'} x {layout.n_cols or 'any'} taxels (n_rows, n_cols)"
    )
    fits = {at: _best_way(layout, array, at).fit for at in axes}
    fits = {at: fit for at, fit in fits.items() if fit != _NO_FIT}
    if not fits:
        # A single frame, as from a file of each frame.
        if _best_way(layout, array, None).fit == _DIRECT and len(array.sides) > 1:
            return [None]
        fault = f"no axis of {array.text} leaves a frame of {shape}"
        raise SourceError(f"{array.where}: {fault}")
    # Times beside the array are a label of the file: a shape that contradicts them is refused.
    timed = [at for at in axes if at is not None and array.sides[at] in n_times]
    candidates: list[int | None] = [at for at in fits if at in timed]
    candidates = candidates or list(fits)
    if timed and candidates[0] not in timed:
        at = timed[0]
        time_axis = f"axis {at + 1} of {array.text}"
        fault = f"{time_axis} is as long as the times, but leaves no frame of {shape}"
        raise SourceError(f"{array.where}: {fault}; state axes, or time=none")
    best = min(fits[at] for at in candidates)
    return [at for at in candidates if fits[at] == best]


def _decided(
    layout: Layout,
    array: ArrayShape,
    axes: Sequence[int | None],
    n_times: Collection[int],
    first_is_usual: bool | None,
) -> tuple[int | None, str]:
    """The only one of several axes, or the usual one; and why."""
    if len(axes) == 1:
        axis = axes[0]
        if axis is None:
            return axis, "the array is one frame of the stated shape"
        if array.sides[axis] in n_times:
            return axis, "as long as the times"
        return axis, "the others have the stated shape"
    is_plausible = _first_is_plausible(array.sides)
    if 0 in axes and (first_is_usual is None or (first_is_usual and is_plausible)):
        return 0, "the first one, as is usual"
    options = [
        {"axes": _axes_text(array, _best_way(layout, array, axis))} for axis in axes
    ]
    ways = [
        f"axes={option['axes']} ({array.sides[axis]} frames)"
        for axis, option in zip(axes, options, strict=True)
        if axis is not None
    ]
    fault = f"which axis of {array.text} is that of the frames is not stated"
    raise UnstatedError(f"{array.where}: {fault}: state {' or '.join(ways)}", *options)


def _first_is_plausible(sides: Sequence[int]) -> bool:
    """True if the first axis is longer than the others, or these are one, or a square, of another
    side.
    """
    item_sides = [side for side in sides[1:] if side > 1]
    is_square = len(item_sides) == 2 and item_sides[0] == item_sides[1] != sides[0]
    is_longest = all(side < sides[0] for side in item_sides)
    is_list = len(item_sides) == 1 and item_sides[0] != sides[0]
    return is_longest or is_list or is_square


def _axes_text(array: ArrayShape, way: _Way) -> str:
    """The setting `axes` for a way, whose rows come before its columns."""
    long_axes = [at for at in array.others(way.axis) if array.sides[at] > 1]
    grid_axes = [at for at in long_axes if at != way.channel]
    names = ["-"] * len(array.sides)
    usual: tuple[str, ...] = ("rows", "cols", CHANNEL)
    if len(grid_axes) == 1:
        usual = ("taxels",)
    for at, name in zip(grid_axes, usual, strict=False):
        names[at] = name
    if way.channel is not None:
        names[way.channel] = CHANNEL
    if way.axis is not None:
        names[way.axis] = "frames"
    return ",".join(names)


def _items(array: ArrayShape, way: _Way) -> Iterator[Axis]:
    """The axes of a frame, with labels where they are known."""
    grid = [
        at for at in array.others(way.axis) if array.sides[at] > 1 and at != way.channel
    ]
    for at in array.others(way.axis):
        label = array.labels[at]
        if at == way.channel:
            label = CHANNEL
        elif at in grid and way.fit & _TRANSPOSED:
            label = ("cols", "rows")[grid.index(at)]
        elif label == "-":
            label = ""
        yield Axis(array.sides[at], label, array.names.get(at, ()))


def _said(way: _Way) -> str:
    return ", whose columns come before its rows" if way.fit & _TRANSPOSED else ""
