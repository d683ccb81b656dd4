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

from .layout import MAX_WAYS, Layout, UnstatedError, listed
from .names import NORMAL, select
from .roles import CHANNEL, COLS, ROWS, XYZ, roles_of
from .roles import Axis as Axis  # part of the interface


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
    # Numbers of the cells are turned and chosen once; each frame is then one lookup.
    places: npt.NDArray[Any] = np.arange(n_numbers)
    notes: tuple[str, ...] = ()
    may_hold_others = False

    is_named = any(axis.names for axis in axes)
    if len(axes) == 1 and (is_named or usable is not None):
        # Columns, of which some may be no taxels.
        names = axes[0].names or ("",) * n_numbers
        remaining = range(n_numbers) if usable is None else usable
        selection = select(layout, names, remaining, where)
        places = places[list(selection.columns)]
        notes = (*selection.notes, *_left_out(names, remaining, selection.columns))
        if selection.shape is not None:
            places = places.reshape(selection.shape)
        # Names with numbers are those of taxels; others may be anything, and the error says so.
        have_numbers = all(re.search(r"\d", names[k]) for k in selection.columns)
        may_hold_others = not (have_numbers or layout.columns)
    else:
        places, notes = _one_channel(layout, places, axes, where)

    places = _as_grid(layout, places, may_hold_others, where)
    n_rows, n_cols = places.shape

    check_grid(n_rows, n_cols, where)
    places = _ordered(layout, places, where)
    # All cells in order: a block of frames is a view, without a copy.
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
    """Shapes of n taxels, the most square ones first: "2 x 3, 3 x 2, 1 x 6 or 6 x 1"; of many the
    last one is "another".
    """
    sides = [
        k for k in range(1, min(n, MAX_SIDE) + 1) if n % k == 0 and n // k <= MAX_SIDE
    ]
    # Most skins are nearly square: those shapes come first.
    sides.sort(key=lambda k: (abs(math.log(k * k / n)), k))
    shapes = [f"{k} x {n // k}" for k in sides[:MAX_WAYS]]
    if len(sides) > MAX_WAYS:
        shapes.append("another")
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
    names_text = listed([*map(printable, unread)])
    return (f"left out: {len(unread)} {columns_text}, {names_text}",)


def _one_channel(
    layout: Layout, places: npt.NDArray[Any], axes: Sequence[Axis], where: str
) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    """The places of one channel, as a list of taxels or as rows and columns."""
    roles, _ = roles_of(layout, axes, where)
    places = places.reshape([axis.size for axis in axes])
    notes: tuple[str, ...] = ()
    if CHANNEL in roles:
        at = roles.index(CHANNEL)
        entry, note = _entry(layout, axes[at], where)
        places = places[(slice(None),) * at + (slice(entry, entry + 1),)]
        notes = (note,)
    if ROWS not in roles:
        return places.reshape(-1), notes
    if roles.index(COLS) < roles.index(ROWS):
        places = places.transpose()
    sizes = {role: axis.size for role, axis in zip(roles, axes, strict=True)}
    return places.reshape(sizes[ROWS], sizes[COLS]), notes


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
    # The force that presses; the others are kept by `recording import --keep`.
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
    layout: Layout, places: npt.NDArray[Any], may_hold_others: bool, where: str
) -> npt.NDArray[Any]:
    """Places as rows and columns; UnstatedError if nothing states them."""
    n_rows = layout.n_rows
    n_cols = layout.n_cols
    if places.ndim == 2:
        # A row of a table, or a column of MATLAB, is a list: a stated shape folds it.
        is_stated_flat = 1 in places.shape and layout.n_stated == places.size
        if not is_stated_flat:
            check_stated_shape(places.shape[0], places.shape[1], n_rows, n_cols, where)
            return places

    n = places.size
    if not (n_rows or n_cols):
        fault = f"a frame holds {n} readings, in which shape is not stated"
        ways = f"state n_rows and n_cols, {shapes_of(n)}"
        if may_hold_others:
            ways += ", or columns if not all are readings"
        raise UnstatedError(f"{where}: {fault}: {ways}")
    # One side is enough: the other follows.
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
