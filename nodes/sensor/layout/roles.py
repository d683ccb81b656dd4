"""What each axis of an array or of a message is: frames, rows, columns, taxels or a channel.

All ways to read the axes that their labels allow are listed. Those that contradict what is stated
are left out, the others are compared by how unusual they are, and of equal ones none is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import permutations
from typing import NamedTuple

from sparseskin.nodes.errors import SourceError

from .layout import Layout, UnstatedError
from .names import COL_WORDS, ROW_WORDS

FRAMES = "frames"
ROWS = "rows"
COLS = "cols"
TAXELS = "taxels"
CHANNEL = "channel"
NONE = "-"
VALUE = "value"
"""Roles of an axis; none: it has one entry; value: a column of a table."""
Roles = tuple[str, ...]
FIRST: Roles = (FRAMES,)
"""Begin of the roles of an array whose first axis is that of the frames."""
XYZ = ("x", "y", "z")
ROW_LABELS = (*ROW_WORDS, "height", "row_count")
COL_LABELS = (*COL_WORDS, "width", "col_count")
LABELS = {
    FRAMES: "frame frames n_frames time times t timestamp timestamps sample samples step steps",
    ROWS: " ".join(ROW_LABELS),
    COLS: " ".join(COL_LABELS),
    CHANNEL: "channel channels axis axes xyz component components dim",
    TAXELS: "taxel taxels sensor sensors",
}
"""Labels that files and messages give an axis, by its role."""
ROLES_OF_ITEMS: tuple[tuple[Roles, ...], ...] = (
    ((),),
    ((TAXELS,), (CHANNEL,)),
    ((ROWS, COLS), (COLS, ROWS), (TAXELS, CHANNEL), (CHANNEL, TAXELS)),
    tuple(permutations((ROWS, COLS, CHANNEL))),
)
"""Roles of the axes of a frame, by their number, in order of preference."""
# How unusual a way is: none of these is outweighed by those above it together.
WITH_TIME = 1  # a number more than taxels: the time
MIDDLE = 1  # the channel stands between rows and columns
TRANSPOSED = 2  # columns come before rows
UNSTATED_CHANNEL = 4
UNUSED_CHANNEL = 8
ONE_FRAME = 16


class Axis(NamedTuple):
    """An axis of an item: its size, what the source calls it, and names of its entries."""

    size: int
    label: str = ""
    names: tuple[str, ...] = ()


def roles_of(
    layout: Layout,
    axes: Sequence[Axis],
    where: str,
    has_frames: bool = False,
    n_times: Collection[int] = (),
    is_first: Callable[[], bool] = lambda: False,
) -> tuple[Roles, bool]:
    """The role of each axis, and whether it is a guess: that the first axis is that of the frames.

    Where several ways are as usual, `is_first` decides, from what the array holds, whether the
    first axis is that of the frames. With `has_frames` one axis is, or the whole array is one frame
    of the stated shape; of several the one as long as times beside the array, `n_times`. Rows come
    before columns unless the shape or a label states otherwise. Raises SourceError if nothing
    agrees with what is stated, UnstatedError if several ways do.
    """
    text = " x ".join(str(axis.size) for axis in axes)
    labelled = _labelled(layout, axes, has_frames)
    if not labelled:
        fault = f"axes = {layout.axes or 'unknown'}, but the array is {text}"
        ways = f"state each of its {len(axes)} axes once, - for one of one entry"
        raise SourceError(f"{where}: {fault}; {ways}")

    # Times are a label of the file: a shape that contradicts them is refused.
    timed = [roles for roles in labelled if _n_frames(axes, roles) in n_times]
    costs = {roles: _cost(layout, axes, roles) for roles in timed or labelled}
    least_cost = min(costs.values())
    if least_cost == math.inf:
        if not has_frames:
            return labelled[0], False  # the arrangement names what contradicts
        shape = f"{layout.n_rows or 'any'} x {layout.n_cols or 'any'} taxels"
        fault = f"no axis of {text} leaves a frame of {shape} (n_rows, n_cols)"
        if timed:
            axis = f"axis {timed[0].index(FRAMES) + 1} of {text}"
            fault = f"{axis} is as long as the times, but leaves no frame of {shape}"
            fault += "; state axes, or time=none"
        raise SourceError(f"{where}: {fault}")
    usual = [roles for roles, cost in costs.items() if cost == least_cost]

    # A side may be as long as the recording: turned frames along another axis are as likely.
    frame_axes = {_frame_axis(roles) for roles in usual}
    usual += [
        roles
        for roles, cost in costs.items()
        if cost <= least_cost + TRANSPOSED and _frame_axis(roles) not in frame_axes
    ]
    if len(usual) == 1:
        return usual[0], False
    firsts = [roles for roles in usual if roles[:1] == FIRST]
    if len(firsts) == 1 and is_first():
        return firsts[0], True
    ways_to_state = [",".join(roles) for roles in usual]
    fault = f"{where}: what each axis of {text} is, is not stated"
    raise UnstatedError.between(fault, "axes", ways_to_state)


def are_roles_possible(layout: Layout, axes: Sequence[Axis]) -> bool:
    """True if an array can hold frames of the stated shape."""
    labelled = _labelled(layout, axes, has_frames=True)
    return any(_cost(layout, axes, roles) < math.inf for roles in labelled)


def _labelled(layout: Layout, axes: Sequence[Axis], has_frames: bool) -> list[Roles]:
    """Roles of all axes that agree with what is stated of them, or else with their labels, in order
    of preference.
    """
    stated = layout.axis_names
    # Labels of the file hold where nothing is stated, or the columns of its lines are.
    if not stated or VALUE in stated:
        possible = _assignments(axes, has_frames)
        return [roles for roles in possible if _allow(axes, roles)]
    if not has_frames:
        stated = tuple(role for role in stated if role != FRAMES)
    if len(stated) == len(axes):
        if not _are_sound(axes, stated):
            return []
        return [stated]
    return [
        roles
        for roles in _assignments(axes, has_frames)
        # Names of the others alone say nothing of the axis of the frames.
        if stated in (_without(roles, NONE), _without(roles, NONE, FRAMES))
    ]


def _without(roles: Roles, *others: str) -> Roles:
    return tuple(role for role in roles if role not in others)


def _are_sound(axes: Sequence[Axis], roles: Roles) -> bool:
    """True if no role is stated twice, and axes without one have one entry."""
    names = _without(roles, NONE)
    pairs = zip(axes, roles, strict=True)
    is_one = all(axis.size == 1 for axis, role in pairs if role == NONE)
    return is_one and len(set(names)) == len(names)


def _assignments(axes: Sequence[Axis], has_frames: bool) -> Iterator[Roles]:
    """Roles of all axes, in order of preference."""
    # None: the array is one frame, as of a file for each.
    frame_axes: list[int | None] = [None]
    if has_frames:
        frame_axes = [*range(len(axes)), None]
    for frame_axis in frame_axes:
        item_axes = [at for at in range(len(axes)) if at != frame_axis]
        items = [at for at in item_axes if axes[at].size != 1]
        # A grid of one row is a grid.
        if len(item_axes) == 2:
            items = item_axes
        if len(items) >= len(ROLES_OF_ITEMS):
            continue
        for roles_of_items in ROLES_OF_ITEMS[len(items)]:
            roles = [NONE] * len(axes)
            if frame_axis is not None:
                roles[frame_axis] = FRAMES
            for at, role in zip(items, roles_of_items, strict=True):
                roles[at] = role
            yield tuple(roles)


def _allow(axes: Sequence[Axis], roles: Roles) -> bool:
    """True if the labels of the axes allow their roles."""
    n_items = len(_without(roles, NONE, FRAMES))
    for at, (axis, role) in enumerate(zip(axes, roles, strict=True)):
        label = label_role(axis)
        if FRAMES in (label, role):
            # An axis of one entry counts frames if it is the first one, or has such a label.
            is_allowed = label in (role, "") and (label or at == 0 or axis.size != 1)
        elif role == TAXELS:
            # A list of taxels may have the label of a side, and alone any.
            is_allowed = label != CHANNEL or n_items == 1
        else:
            is_allowed = label in ("", TAXELS, role) or role == NONE
        if not is_allowed:
            return False
    return True


def label_role(axis: Axis) -> str:
    """The role that the label of an axis states, or names x, y, z of its entries; "" if none."""
    if tuple(map(str.lower, axis.names)) == XYZ:
        return CHANNEL
    word = axis.label.lower()
    return next((role for role, labels in LABELS.items() if word in labels.split()), "")


def _frame_axis(roles: Roles) -> int | None:
    if FRAMES not in roles:
        return None
    return roles.index(FRAMES)


def _n_frames(axes: Sequence[Axis], roles: Roles) -> int | None:
    axis = _frame_axis(roles)
    if axis is None:
        return None
    return axes[axis].size


def _cost(layout: Layout, axes: Sequence[Axis], roles: Roles) -> float:
    """How unusual roles are; infinite if they contradict the stated shape or channel."""
    sizes = {role: axis.size for role, axis in zip(roles, axes, strict=True)}
    n_stated = layout.n_stated
    if not _has_shape(layout, sizes):
        return math.inf
    cost = 0
    if ROWS in sizes and roles.index(COLS) < roles.index(ROWS):
        labels = {label_role(axis) for axis in axes}
        # Of a single frame, a shape alone is no reason to turn it.
        if FRAMES not in roles and not (layout.axes or {ROWS, COLS} & labels):
            return math.inf
        # With the frames between them, neither order is usual.
        between = roles[roles.index(COLS) : roles.index(ROWS)]
        cost += TRANSPOSED * (FRAMES not in between)
    elif ROWS not in sizes and n_stated is not None:
        cost += WITH_TIME * (sizes.get(TAXELS, 1) == n_stated + 1)

    if CHANNEL not in sizes:
        cost += UNUSED_CHANNEL * bool(layout.channel)
    elif not layout.axes and label_role(axes[roles.index(CHANNEL)]) != CHANNEL:
        items = _without(roles, FRAMES)
        is_at_end = CHANNEL in (items[0], items[-1])
        if layout.channel and not _may_hold(layout.channel, sizes[CHANNEL]):
            return math.inf
        if n_stated is not None:
            cost += MIDDLE * (not is_at_end) + UNSTATED_CHANNEL * (not layout.channel)
        elif ROWS in sizes:
            cost += UNSTATED_CHANNEL * (not layout.channel)
        elif not (is_at_end and _may_be_force(axes, roles)):
            return math.inf
    if FRAMES not in roles and not layout.axes:
        # As from a file of each frame; of a message all ways are so.
        cost += ONE_FRAME
    return cost


def _may_be_force(axes: Sequence[Axis], roles: Roles) -> bool:
    """True if frames of 1 x 4 x 3 numbers may be three of each of 1 x 4 taxels, as of no label."""
    has_labels = any(axis.label for axis in axes)
    is_of_three = axes[roles.index(CHANNEL)].size == len(XYZ)
    return is_of_three and FRAMES in roles and len(axes) == 4 and not has_labels


def _has_shape(layout: Layout, sizes: dict[str, int]) -> bool:
    """True if sizes of axes, by their roles, are of a frame of the stated shape."""
    n_stated = layout.n_stated
    if ROWS in sizes:
        n_rows = sizes[ROWS]
        n_cols = sizes[COLS]
        if n_stated == n_rows * n_cols and 1 in (n_rows, n_cols):
            return True
        is_high = n_rows == (layout.n_rows or n_rows)
        return is_high and n_cols == (layout.n_cols or n_cols)
    # A row may hold more than taxels, where these or the times are stated apart.
    n = sizes.get(TAXELS, 1)
    if layout.columns or layout.has_time_column:
        return n >= (n_stated or 1)
    if n_stated is not None:
        return n in (n_stated, n_stated + 1)
    # Rows alone, or columns alone, have to divide the readings.
    return n % (layout.n_rows or layout.n_cols or 1) == 0


def _may_hold(channel: str, size: int) -> bool:
    """True if an axis with so many entries can be that of the channels."""
    if channel.isdecimal():
        return int(channel) < size
    return channel.lower() not in XYZ or size == len(XYZ)
