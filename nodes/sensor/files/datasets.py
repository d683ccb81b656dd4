"""Files of named arrays: which of them are the frames, their times, and properties of the skin."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.fields import MAX_ELEMENTS
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout import times
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.checks import choose, shown
from sparseskin.nodes.sensor.layout.layout import Layout, UnstatedError
from sparseskin.nodes.sensor.layout.roles import are_roles_possible

TACTILE = "tactile_data"
"""Part of the names of arrays of tactile datasets."""
FORCES = "forces"
"""Name of the array of frames in what this package writes."""
STAMPS = "stamp_ns"
MASK = "mask"
POINTS = "points"
POINT_ROWS = "point_rows"
UNIT = "unit"
RATE = "rate_hz"
F_MAX = "f_max"
PITCH = "pitch_m"
PROPERTIES = frozenset({MASK, POINTS, POINT_ROWS, UNIT, RATE, F_MAX, PITCH, STAMPS})
"""Names of the arrays beside it."""
SCALE = "scale_factor"
OFFSET = "add_offset"
FILL_VALUES = ("_FillValue", "missing_value")
"""Attributes of numbers that stand for others, and of those that stand for none."""
NO_UNITS = frozenset({"", "-", "1", "none", "unknown", "n/a"})
MAX_STATE = 32
"""Numbers of a row up to which a table does not compete with an array of frames, chosen: the joints
and poses of an arm with a hand are fewer."""
MAX_ARRAYS = 4096
"""Arrays of a file that are looked at, chosen."""
MAX_SHOWN = 8
NO_TIMES = "none"
MAX_PROPERTY_BYTES = 64 * MAX_ELEMENTS
"""Largest array of a property: points of a skin, six float64 for each taxel, with a margin."""


@dataclass(frozen=True)
class Dataset:
    """An array of a file before it is read, with labels of its axes, () where the file has none,
    the attributes of itself and of the groups around it, and names of the entries of an axis.
    """

    sides: tuple[int, ...]
    dtype: np.dtype[Any]
    labels: tuple[str, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    names: Mapping[int, tuple[str, ...]] = field(default_factory=dict)

    @property
    def n_axes(self) -> int:
        """Axes of more than one entry."""
        return sum(side > 1 for side in self.sides)

    @property
    def is_list(self) -> bool:
        """True if it holds several numbers along one axis."""
        return self.n_axes == 1

    @property
    def n_bytes(self) -> int:
        return math.prod(self.sides) * self.dtype.itemsize

    @property
    def text(self) -> str:
        """Its sides, as "5 x 4 x 3"."""
        return " x ".join(map(str, self.sides)) or "one number"


class ArrayFile(ABC):
    """A file of named arrays. Its methods raise SourceError if the file is malformed."""

    #: In paths of arrays, between their parts.
    separator = "/"
    #: True if programs that write such files have the frames along the first axis.
    has_frames_first = True

    def __init__(self, name: str) -> None:
        self.name = name
        self.datasets: dict[str, Dataset] = {}
        #: For the log.
        self.notes: tuple[str, ...] = ()

    @abstractmethod
    def whole(self, key: str) -> npt.NDArray[Any]:
        """An array."""

    @abstractmethod
    def blocks(self, key: str, axis: int, size: int) -> Iterator[npt.NDArray[Any]]:
        """An array by blocks of about `size` entries of an axis, which comes first: (k, ...)."""

    def where(self, key: str) -> str:
        """Place of an array, for errors."""
        if not key:
            return self.name
        return f"{self.name}, array {shown(key)}"

    def last_part(self, key: str) -> str:
        return key.rpartition(self.separator)[2]

    def nearest(self, key: str, name: str) -> str:
        """The path of the array with a name in the group of an array, or else in the nearest group
        around it; "" if there is none.
        """
        group = key
        while group:
            group = group.rpartition(self.separator)[0]
            path = name
            if group:
                path = f"{group}{self.separator}{name}"
            if path in self.datasets:
                return path
        return ""

    def axes(self, key: str) -> list[Axis]:
        """The axes of an array, with their labels and names of entries."""
        dataset = self.datasets[key]
        labels = dataset.labels or ("",) * len(dataset.sides)
        return [
            Axis(side, labels[at], dataset.names.get(at, ()))
            for at, side in enumerate(dataset.sides)
        ]

    def property_array(self, key: str) -> npt.NDArray[Any]:
        """An array that is no larger than one of a property. Raises SourceError if it is."""
        n_bytes = self.datasets[key].n_bytes
        if n_bytes > MAX_PROPERTY_BYTES:
            raise SourceError(
                f"{self.where(key)}: {n_bytes} bytes; at most {MAX_PROPERTY_BYTES}"
            )
        return self.whole(key)


def frames_key(arrays: ArrayFile, layout: Layout) -> str:
    """The array of the frames: the stated topic, a path or the last part of one; `forces`; the only
    array of three axes or more, or else of two, that can have the stated shape. Raises SourceError
    if there is none, UnstatedError if there are several.
    """
    topic = layout.topic.strip("/")
    if topic in arrays.datasets and topic:
        return topic
    # What this program writes has its array named so.
    name = topic or FORCES
    so_named = [key for key in arrays.datasets if arrays.last_part(key) == name]
    if len(so_named) == 1:
        return so_named[0]
    kind = "arrays of frames (frames, rows, columns)"
    if topic:
        kind = f"arrays named {shown(topic)}"
    candidates = so_named
    if not topic or not so_named:
        candidates = _candidates(arrays, layout)
    grids = [key for key in candidates if arrays.datasets[key].n_axes > 2]

    # One grid among tables is the skin, unless a table is as large.
    if len(grids) == 1 and not topic:
        candidates = [*grids, *_rivals(arrays, grids[0], candidates)]
    texts = {key: arrays.datasets[key].text for key in candidates}
    return choose(texts, "" if so_named else topic, arrays.name, kind)


def _candidates(arrays: ArrayFile, layout: Layout) -> list[str]:
    """Arrays that may be frames; those of bool only where there are no others."""
    if len(arrays.datasets) == 1:
        return [*arrays.datasets]
    keys = []
    for key, dataset in arrays.datasets.items():
        name = arrays.last_part(key)
        is_property = name in PROPERTIES or times.is_time_name(name)
        if dataset.dtype.kind in "iufb" and dataset.n_axes > 1 and not is_property:
            keys.append(key)
    # Where arrays are labelled as tactile data, others are none; masks are of bool.
    keys = [key for key in keys if TACTILE in arrays.last_part(key)] or keys
    keys = [key for key in keys if arrays.datasets[key].dtype.kind != "b"] or keys
    fitting = [key for key in keys if are_roles_possible(layout, arrays.axes(key))]
    return fitting or keys


def _rivals(arrays: ArrayFile, grid: str, keys: Sequence[str]) -> list[str]:
    """Tables that may be the frames though there is one array of three axes."""
    # Joints and poses are small tables; one as large as the grid may be the skin itself.
    rivals = []
    sides = arrays.datasets[grid].sides
    for key in keys:
        if key == grid:
            continue
        table_sides = [side for side in arrays.datasets[key].sides if side > 1]
        shared = [side for side in table_sides if side in sides]
        n_frames = max(table_sides)
        if shared:
            n_frames = shared[0]
        n_columns = math.prod(table_sides) // n_frames
        if n_columns > MAX_STATE or n_columns * n_frames >= math.prod(sides):
            rivals.append(key)
    return rivals


def times_keys(arrays: ArrayFile, layout: Layout) -> list[str]:
    """Arrays of one axis that hold times: the stated one, or those with a name of times, alone or
    behind another word. Raises SourceError if the stated one is none.
    """
    time_name = layout.time
    if time_name == NO_TIMES or layout.has_time_column:
        return []
    lists = [
        key
        for key, dataset in arrays.datasets.items()
        if dataset.is_list and dataset.dtype.kind in "iufMmUS"
    ]
    if not time_name:
        exact = [key for key in lists if times.is_time_name(arrays.last_part(key))]
        return exact or [key for key in lists if times.is_time_name(_words(key)[-1])]
    # A path is meant before the last part of others.
    if time_name in lists:
        return [time_name]
    keys = [key for key in lists if arrays.last_part(key) == time_name]
    if not keys:
        allowed = ", ".join(map(printable, lists[:MAX_SHOWN])) or "none"
        fault = f"{shown(time_name)} is no array of one axis; allowed: {allowed}, none"
        raise SourceError(f"{arrays.name}: time: {fault}")
    return keys


def times_key(
    arrays: ArrayFile, layout: Layout, frames: str, keys: Sequence[str], n_frames: int
) -> tuple[str, tuple[str, ...]]:
    """The times of the frames of an array, "" if there are none, and what is to be said. Raises
    SourceError if those that are stated are not as many as the frames, UnstatedError if there are
    several, as near as each other to the array.
    """
    if layout.rate_hz is not None:
        return "", ()
    if not keys and not layout.time:
        _ask_for_times(arrays, frames, n_frames)
    n_times = {key: math.prod(arrays.datasets[key].sides) for key in keys}
    as_long = [key for key in keys if n_times[key] == n_frames]
    if not as_long:
        sizes = ", ".join(f"{printable(key)} ({n})" for key, n in n_times.items())
        note = f"not read as times of {n_frames} frames: {sizes}"
        if keys and layout.time:
            raise SourceError(f"{arrays.name}: time: {note}")
        if not keys:
            return "", ()
        return "", (note,)

    # In the same group, or with the same word at its begin: left_t beside left_pad.
    nearness = {key: _common_words(key, frames) for key in as_long}
    nearest = [key for key in as_long if nearness[key] == max(nearness.values())]
    if len(nearest) > 1:
        fault = f"{arrays.name}: {len(nearest)} arrays may be the times of the frames"
        raise UnstatedError.between(fault, "time", nearest, "time=none")
    ignored = [printable(key) for key in as_long if key not in nearest]
    notes: tuple[str, ...] = ()
    if ignored:
        notes = (f"not read as times: {', '.join(ignored)}",)
    return nearest[0], notes


def _ask_for_times(arrays: ArrayFile, frames: str, n_frames: int) -> None:
    """Raise UnstatedError if an array of one number for each frame rises: likely the times. One
    that rises by 1 counts.
    """
    # As for columns of a table: times whose name is in another language.
    rising = []
    for key, dataset in arrays.datasets.items():
        is_of_frames = dataset.is_list and math.prod(dataset.sides) == n_frames
        if not is_of_frames or key == frames or dataset.dtype.kind not in "iuf":
            continue
        numbers = arrays.property_array(key).reshape(-1)
        if times.are_likely(numbers, times.SAME_STEPS):
            rising.append(key)
    if rising and n_frames >= times.FEW_RISING:
        fault = f"{arrays.name}: a number for each frame rises, and is named as no time"
        raise times.which_times(fault, rising, n_frames)


def _words(key: str) -> list[str]:
    return key.lower().replace("/", "_").replace(".", "_").split("_")


def _common_words(path: str, other_path: str) -> int:
    """Words with which two paths begin alike."""
    n = 0
    for word, other_word in zip(_words(path), _words(other_path), strict=False):
        if word != other_word:
            break
        n += 1
    return n
