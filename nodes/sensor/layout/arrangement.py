"""From the numbers of one item (a line, a message, a frame of an array) to a frame."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.messages.fields import MAX_ELEMENTS, MAX_SIDE
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Indices

from .layout import Layout, UnstatedError
from .names import COL_WORDS, NORMAL, ROW_WORDS, select

ROWS = (*ROW_WORDS, "height", "row_count")
COLS = (*COL_WORDS, "width", "col_count")
UNNAMED = "numbers"
"""Label of columns without names, of which some may be no taxels."""
CHANNELS = (
    "channel",
    "channels",
    "axis",
    "axes",
    "xyz",
    "component",
    "components",
    "dim",
)
XYZ = ("x", "y", "z")
MAX_WAYS = 8


class Axis(NamedTuple):
    """An axis of an item: its size, what the source calls it, and names of its entries."""

    size: int
    label: str = ""
    names: tuple[str, ...] = ()


class Arrangement(NamedTuple):
    """Places of the taxels in an item: `places` (n_rows, n_cols) into its numbers in order, or
    None where they are a frame as they are.
    """

    shape: tuple[int, int]
    places: Indices | None
    notes: tuple[str, ...] = ()

    def frames(self, numbers: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Frames (k, n_rows, n_cols) of the numbers of k items, (k, ...)."""
        flat = numbers.reshape(len(numbers), -1)
        if self.places is None:
            return flat.reshape(-1, *self.shape)
        return flat[:, self.places]


def arrange(
    layout: Layout,
    axes: Sequence[Axis],
    where: str,
    usable: Sequence[int] | None = None,
) -> Arrangement:
    """Places of the taxels in items with these axes.

    `usable` are the entries of a single named axis that hold numbers; None: all. Names and labels
    of the source come first, then what is stated; of x, y and z the normal one is read. Raises
    SourceError if what is stated contradicts the source, UnstatedError if the shape is missing.
    """
    sizes = [axis.size for axis in axes]
    n_numbers = math.prod(sizes)
    if not 1 <= n_numbers <= 16 * MAX_ELEMENTS:
        raise SourceError(
            f"{where}: an item holds {n_numbers} numbers; allowed: 1..{MAX_ELEMENTS}"
        )
    places = np.arange(n_numbers).reshape(sizes)
    labelled = list(axes)
    notes: tuple[str, ...] = ()

    is_named = any(axis.names for axis in axes)
    if len(axes) == 1 and (is_named or usable is not None):
        # Columns, of which some may be no taxels.
        names = axes[0].names or ("",) * n_numbers
        remaining = range(n_numbers) if usable is None else usable
        selection = select(layout, names, remaining, where)
        places = places[list(selection.columns)]
        notes = (*selection.notes, *_left_out(names, remaining, selection.columns))
        if selection.shape is not None:
            n_rows, n_cols = selection.shape
            places = places.reshape(n_rows, n_cols)
            labelled = [Axis(n_rows, "rows"), Axis(n_cols, "cols")]
        else:
            have_numbers = all(re.search(r"\d", names[k]) for k in selection.columns)
            is_certain = have_numbers or bool(layout.columns)
            labelled = [Axis(places.size, "taxels" if is_certain else UNNAMED)]
    else:
        places, labelled, notes = _one_channel(layout, places, labelled, where)

    places = _as_grid(layout, places, labelled, where)
    n_rows, n_cols = places.shape

    check_grid(n_rows, n_cols, where)
    places = _ordered(layout, places, where)
    if places.size == n_numbers and bool((np.diff(places.ravel()) == 1).all()):
        return Arrangement((n_rows, n_cols), None, notes)
    return Arrangement((n_rows, n_cols), places, notes)


def check_grid(n_rows: int, n_cols: int, where: str) -> None:
    """Raise SourceError unless both sides are in 1..4096 and the cells at most 2**20."""
    if not (1 <= n_rows <= MAX_SIDE and 1 <= n_cols <= MAX_SIDE):
        sides = f"{n_rows} rows x {n_cols} columns"
        raise SourceError(f"{where}: {sides}; allowed are 1..{MAX_SIDE} of each")
    if n_rows * n_cols > MAX_ELEMENTS:
        cells = f"{n_rows} x {n_cols} = {n_rows * n_cols} cells"
        raise SourceError(f"{where}: {cells}; at most {MAX_ELEMENTS}")


def order_of(text: str, n: int) -> list[int] | None:
    """Places of n rows or columns as sent: "forward", "reversed" or "2,0,1"; None: other texts."""
    if text == "forward":
        return list(range(n))
    if text == "reversed":
        return list(range(n))[::-1]
    parts = text.split(",")
    if len(parts) != n or not all(
        p.strip().isdecimal() and len(p.strip()) < 6 for p in parts
    ):
        return None
    order = [int(part) for part in parts]
    if sorted(order) != list(range(n)):
        return None
    return order


def shapes_of(n: int) -> str:
    """Shapes of n taxels, the most square ones first: "2 x 3, 3 x 2, 1 x 6 or 6 x 1"."""
    sides = [
        k for k in range(1, min(n, MAX_SIDE) + 1) if n % k == 0 and n // k <= MAX_SIDE
    ]
    sides.sort(key=lambda k: (abs(math.log(k * k / n)), k))
    shapes = [f"{k} x {n // k}" for k in sides[:MAX_WAYS]]
    if len(shapes) < 2:
        return "".join(shapes)
    return f"{', '.join(shapes[:-1])} or {shapes[-1]}"


def _left_out(
    names: Sequence[str], usable: Sequence[int], columns: Sequence[int]
) -> tuple[str, ...]:
    """A note on the columns of numbers that are not read, if there are any."""
    of_taxels = set(columns)
    unread = [names[k] or str(k + 1) for k in usable if k not in of_taxels]
    if not unread:
        return ()
    columns_text = "column" if len(unread) == 1 else "columns"
    names_text = ", ".join(map(printable, unread[:MAX_WAYS]))
    if len(unread) > MAX_WAYS:
        names_text += ", ..."
    return (f"left out: {len(unread)} {columns_text}, {names_text}",)


def _one_channel(
    layout: Layout, places: npt.NDArray[Any], axes: list[Axis], where: str
) -> tuple[npt.NDArray[Any], list[Axis], tuple[str, ...]]:
    """The places of one channel, without axes of one entry."""
    if len(axes) > 2:
        axes = [axis for axis in axes if axis.size > 1] or axes[-1:]
    places = places.reshape([axis.size for axis in axes])

    at = _channel_axis(layout, axes, where)
    if at is None and len(axes) > 2:
        hint = "state axes, as rows,cols,channel, and channel"
        raise UnstatedError(
            f"{where}: an item has {len(axes)} axes, {_sides(axes)}; {hint}"
        )
    if at is None:
        return places, axes, ()
    entry, note = _entry(layout, axes[at], where)
    return np.take(places, entry, axis=at), axes[:at] + axes[at + 1 :], (note,)


def _channel_axis(layout: Layout, axes: list[Axis], where: str) -> int | None:
    """The axis of the channels: by its label, or where a channel is stated the smallest one that
    may have it and leaves a frame. UnstatedError if there are two.
    """
    for at, axis in enumerate(axes):
        if axis.label.lower() in CHANNELS or tuple(map(str.lower, axis.names)) == XYZ:
            return at
    # An axis of two may be the channels only if the number of taxels shows it.
    min_axes = 3 if layout.n_stated is None else 2
    if not layout.channel or len(axes) < min_axes:
        return None

    n_numbers = math.prod(axis.size for axis in axes)
    fitting = []
    for at, axis in enumerate(axes):
        leaves_frame = layout.n_stated in (None, n_numbers // axis.size)
        if leaves_frame and may_hold_channel(layout.channel, axis.size):
            fitting.append(at)
    if not fitting:
        return len(axes) - 1 if len(axes) == 3 else None
    min_size = min(axes[at].size for at in fitting)
    smallest = [at for at in fitting if axes[at].size == min_size]
    if len(smallest) > 1:
        fault = (
            f"which axis of {_sides(axes)} has channel {layout.channel} is not stated"
        )
        ways = [_with_channel_at(at, len(axes)) for at in smallest]
        raise UnstatedError.between(f"{where}: {fault}", "axes", ways)
    return smallest[0]


def _sides(axes: Sequence[Axis]) -> str:
    """Sizes of axes, as "4 x 4 x 3"."""
    return " x ".join(str(axis.size) for axis in axes)


def _with_channel_at(at: int, n_axes: int) -> str:
    """The setting `axes` of the axes of an item."""
    names = ["rows", "cols"] if n_axes == 3 else ["taxels"]
    return ",".join([*names[:at], "channel", *names[at:]])


def may_hold_channel(channel: str, size: int) -> bool:
    """True if an axis with so many entries can be that of the channels."""
    if channel.isdecimal():
        return int(channel) < size
    return channel.lower() not in XYZ or size == len(XYZ)


def _entry(layout: Layout, axis: Axis, where: str) -> tuple[int, str]:
    """The entry of an axis of channels that is read, and what is to be said about it."""
    names = tuple(map(str.lower, axis.names))
    if (
        not names
        and axis.size == len(XYZ)
        and axis.label.lower() in ("xyz", "axis", "axes")
    ):
        names = XYZ
    channel = layout.channel.lower()
    if not channel and NORMAL in names:
        channel = NORMAL

    if channel in names:
        return names.index(channel), f"channel {channel} of {', '.join(names)}"
    if not names and channel in XYZ and axis.size == len(XYZ):
        entry = XYZ.index(channel)
        return entry, f"channel {channel}, entry {entry} of {axis.size}"
    if channel.isdecimal() and int(channel) < axis.size:
        return int(channel), f"channel {channel} of {axis.size}"
    allowed = ", ".join(names) or f"0..{axis.size - 1}"
    if channel:
        raise SourceError(f"{where}: channel: {channel!r} is none of {allowed}")
    raise UnstatedError(
        f"{where}: {axis.size} numbers per taxel; state channel, of {allowed}"
    )


def _as_grid(
    layout: Layout, places: npt.NDArray[Any], axes: list[Axis], where: str
) -> npt.NDArray[Any]:
    """Places as rows and columns; UnstatedError if nothing states them."""
    n_rows = layout.n_rows
    n_cols = layout.n_cols
    if len(axes) == 2:
        labels = [axis.label.lower() for axis in axes]
        is_transposed = labels[0] in COLS or (
            labels[1] in ROWS and labels[0] not in ROWS
        )
        grid = places.T if is_transposed else places
        is_stated_flat = 1 in grid.shape and layout.n_stated == grid.size
        if not is_stated_flat:
            check_stated_shape(grid.shape[0], grid.shape[1], n_rows, n_cols, where)
            return grid
        places = grid

    n = places.size
    if not (n_rows or n_cols):
        fault = f"a frame holds {n} readings, in which shape is not stated"
        ways = f"state n_rows and n_cols, {shapes_of(n)}"
        if axes[0].label == UNNAMED:
            ways += ", or columns if not all are readings"
        raise UnstatedError(f"{where}: {fault}: {ways}")
    n_rows = n_rows or max(1, n // (n_cols or 1))
    n_cols = n_cols or max(1, n // n_rows)
    if n_rows * n_cols != n:
        needed = f"n_rows x n_cols = {n_rows} x {n_cols} needs {n_rows * n_cols}"
        raise SourceError(f"{where}: a frame holds {n} readings, but {needed}")

    flat = places.reshape(-1)

    if layout.order == "columns":
        return flat.reshape(n_cols, n_rows).T
    return flat.reshape(n_rows, n_cols)


def check_stated_shape(
    rows: int, cols: int, n_rows: int | None, n_cols: int | None, where: str
) -> None:
    """Raise SourceError if a stated side, `n_rows` or `n_cols`, is not that of the frames."""
    for key, required, actual in (("n_rows", n_rows, rows), ("n_cols", n_cols, cols)):
        if required is not None and required != actual:
            raise SourceError(
                f"{where}: {key} = {required} is stated, but the frames have {actual}"
            )


def _ordered(layout: Layout, places: npt.NDArray[Any], where: str) -> npt.NDArray[Any]:
    """Places with rows and columns in their stated order: entry k that comes is put at order[k]."""
    for key, axis in (("row_order", 0), ("col_order", 1)):
        text = getattr(layout, key)
        n = places.shape[axis]
        order = order_of(text, n)
        if order is None:
            allowed = (
                f"allowed: forward, reversed, or each of 0..{n - 1} once, with commas"
            )
            raise SourceError(
                f"{where}: {key}: {text[:40]!r} is not allowed; {allowed}"
            )
        # The inverse of the order: entry k is put at order[k].
        places = np.take(places, np.argsort(order), axis=axis)
    return places
