"""Fields of messages by their path: sensors[0].taxels[].z, where [] is an axis and [0] an entry."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.roles import COL_LABELS, ROW_LABELS, XYZ
from sparseskin.plugins.bridges.cdr import CLOUD

from .decoding import Message
from .definitions import TIME
from .grids import KINDS, MAX_NUMBERS, EmptyMessageError, Numbers, fields_of, grid_of

STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d{0,9}\])*)")
INDEX = re.compile(r"\[(\d*)\]")
ENDING = re.compile(r"(.*?)((?:\[\])*)", re.DOTALL)
"""A path, without the axes at its end, and these."""
NO_READINGS = re.compile(
    r"(.*_)?(ids?|index|seq|count|stamps?|sec|nsec|nanosec|time.*)"
)
"""Fields of messages that are no readings, where there are others."""
NAMES = (
    "name",
    "names",
    "label",
    "labels",
    "id",
    "ids",
    "index",
    "indices",
    "taxel_id",
)
"""Members beside numbers that name them."""
COMPRESSED = ("CompressedImage", "CompressedVideo", "CompressedPointCloud2")
MAX_LISTED = 8
"""Most entries of a list of which each may be a skin of its own; chosen."""
MAX_PATHS = 256
"""Most fields of a message that are looked at; chosen."""
NORMAL = "z"

Step = str | int | None
"""A name, an entry, or an axis."""


def steps_of(path: str) -> list[Step]:
    """The steps of a path. Raises SourceError if it is none."""
    steps: list[Step] = []
    for part in path.split("."):
        match = STEP.fullmatch(part)
        if match is None:
            allowed = "allowed: names and [k] or [], as sensors[0].taxels[].z"
            raise SourceError(f"field: {printable(path[:60])!r}; {allowed}")
        steps.append(match[1])
        for index in INDEX.findall(match[2]):
            steps.append(int(index) if index else None)
    return steps


def numbers_at(message: Message, path: str) -> Numbers:
    """The numbers at a path of a message.

    A list of three or two numbers of fixed length per entry is an axis of channels. All other axes
    are one, unless their names are those of rows or columns. Raises EmptyMessageError if there are
    none, SourceError if there is no such field, or its lists have several lengths.
    """
    # A message that is a frame by itself needs no path.
    if message.kind in KINDS and (not path or path in fields_of(message)):
        return grid_of(message, path)

    walked = _walk(message, steps_of(path), 0, ())
    values = walked.values
    if values.size == 0:
        raise EmptyMessageError("holds no number")
    if values.size > MAX_NUMBERS:
        raise SourceError(f"{values.size} numbers; at most {MAX_NUMBERS}")
    # Contact switches are readings of 0 and 1.
    if values.dtype.kind == "b":
        values = values.view(np.uint8)
    if values.dtype.kind not in "iuf":
        raise SourceError(f"field: {printable(path[:60])!r} holds no numbers")

    if walked.is_grid:
        return Numbers(values, walked.axes)
    numbers = _joined(walked._replace(values=values))
    names = _names_beside(message, steps_of(path), values.size)
    if names and len(numbers.axes) == 1:
        (axis,) = numbers.axes
        return Numbers(numbers.values, (axis._replace(names=names),))
    return numbers


def _names_beside(message: Message, steps: list[Step], n: int) -> tuple[str, ...]:
    """Names of the n numbers of a list that stand beside them, where they are in no order; ()
    where there are none. Names without a number say nothing of the order.
    """
    if steps.count(None) != 1:
        return ()
    # Beside a list, or in each entry of a list of messages.
    is_list = steps[-1] is None
    stem = steps[:-2] if is_list else steps[:-1]
    ending = [None] if is_list else []

    for name in NAMES:
        try:
            values = _walk(message, [*stem, name, *ending], 0, ()).values
        except SourceError:
            continue
        if values.ndim != 1 or values.dtype.kind not in "iuU":
            continue

        texts = tuple(map(str, values.tolist()))
        digits = [re.search(r"\d+", text) for text in texts]
        numbers = [int(match[0]) for match in digits if match is not None]
        are_names = len(texts) == n == len(numbers) == len(set(texts))
        # Names in order are those of the order of the message.
        if are_names and numbers != sorted(numbers):
            return tuple(map(_taxel_name, texts))
    return ()


def _taxel_name(text: str) -> str:
    # A bare number would pass for a place in a list.
    if text.isdecimal():
        return f"taxel_{text}"
    return text


def value_at(message: Message, path: str) -> int | float | Message:
    """One number, or a time, at a path of a message. Raises SourceError if there is none."""
    value: Any = message
    try:
        for step in steps_of(path):
            value = value[step]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise SourceError(
            f"time: there is no field {printable(path[:60])!r}"
        ) from error

    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Message) and value.kind == TIME:
        return value
    if isinstance(value, int | float):
        return value
    raise SourceError(f"time: {printable(path[:60])!r} is no time")


def paths_of(message: Message, channel: str = "") -> dict[str, Numbers]:
    """The fields of a message that hold lists of numbers, by their path: of fields named x, y and z
    beside each other that of the channel, or z.
    """
    if message.kind.rpartition("/")[2] in COMPRESSED:
        raise SourceError(
            f"{message.kind} is compressed; record the messages that it is made of"
        )
    fields: dict[str, Numbers] = {}
    for path in only_channel(_paths(message), channel):
        # Lists may be empty, or of several lengths.
        with suppress(SourceError):
            fields[path] = numbers_at(message, path)

    # Counters and times are fields of readings only where nothing else is.
    paths = [path for path in fields if not NO_READINGS.fullmatch(_last_name(path))]
    readings = {path: fields[path] for path in paths}
    return readings or fields


class _Walked(NamedTuple):
    """Numbers behind some steps, and their axes; `is_grid`: those of a message of `KINDS`."""

    values: npt.NDArray[Any]
    axes: tuple[Axis, ...]
    is_grid: bool = False
    # The last axis is a list of numbers, and no list of messages.
    has_channels: bool = False


def _walk(
    value: Any, steps: list[Step], n_open: int, axes: tuple[Axis, ...]
) -> _Walked:
    """The numbers behind the steps. `value` has the first `n_open` axes already."""
    name = ""
    for at, step in enumerate(steps):
        if isinstance(value, Message):
            if step in fields_of(value):
                grid = grid_of(value, str(step))
                return _Walked(grid.values, (*axes, *grid.axes), True)
            value = _of_message(value, step)
        elif isinstance(value, list):
            if step is None:
                return _stacked(value, steps[at + 1 :], name, axes)
            value = _entry(value, step, name)
        elif isinstance(value, np.ndarray) and isinstance(step, str):
            value = _member_of(value, step)
        elif isinstance(value, np.ndarray) and n_open < value.ndim:
            if step is None:
                axes = (*axes, Axis(value.shape[n_open], name))
                n_open += 1
            else:
                value = _entry(value, step, name, n_open)
        else:
            raise SourceError(f"field: {printable(name)!r} is no list")
        if isinstance(step, str):
            name = step

    if isinstance(value, Message) and value.kind in KINDS:
        grid = grid_of(value)
        return _Walked(grid.values, (*axes, *grid.axes), True)
    # A list of texts may be the names of numbers.
    is_of_texts = isinstance(value, list) and all(isinstance(v, str) for v in value)
    if not (is_of_texts or isinstance(value, np.ndarray | int | float | str)):
        raise SourceError(
            "field: a list of messages; state [] or [k], and the name of a number"
        )

    values = np.asarray(value)
    inner_axes = tuple(Axis(size, name) for size in values.shape[n_open:])
    has_channels = bool(inner_axes) or steps[-1:] == [None]
    return _Walked(values, (*axes, *inner_axes), has_channels=has_channels)


def _of_message(message: Message, step: Step) -> Any:
    if isinstance(step, str) and step in message:
        return message[step]
    names = ", ".join(printable(name) for name in [*message][:MAX_LISTED])
    step_text = "[]" if step is None else printable(str(step))
    raise SourceError(
        f"field: {message.kind} has no member {step_text}; it has {names}"
    )


def _member_of(array: Any, name: str) -> Any:
    names = array.dtype.names or ()
    if name not in names:
        raise SourceError(
            f"field: there is no {printable(name)!r}; allowed: {', '.join(names)}"
        )
    return array[name]


def _entry(values: Any, step: Step, name: str, n_open: int = 0) -> Any:
    """The entry of a list, which is the next axis of an array."""
    size = len(values) if isinstance(values, list) else values.shape[n_open]
    if not isinstance(step, int):
        raise SourceError(
            f"field: {printable(name)!r} is a list; state {name}[] or {name}[0]"
        )
    if size == 0:
        raise EmptyMessageError("holds no number")
    if step >= size:
        raise SourceError(f"field: {name}[{step}]: its list has {size} entries")

    if isinstance(values, list):
        return values[step]
    # The axes that are open already stand before it.
    open_axes = [slice(None)] * n_open
    return np.asarray(values[(*open_axes, step)])


def _stacked(
    values: list[Any], steps: list[Step], name: str, axes: tuple[Axis, ...]
) -> _Walked:
    """The numbers of each entry of a list, together."""
    if not values:
        raise EmptyMessageError("holds no number")

    # Each entry is walked by itself, and all must have one shape.
    parts = [_walk(value, steps, 0, ()) for value in values]
    shapes = {part.values.shape for part in parts}
    if len(shapes) > 1:
        sizes = ", ".join(str(part.values.size) for part in parts[:MAX_LISTED])
        raise SourceError(
            f"field: the entries of {name} hold {sizes} numbers; state {name}[0]"
        )

    stacked = np.stack([part.values for part in parts])
    entry_axes = parts[0].axes
    return parts[0]._replace(
        values=stacked, axes=(*axes, Axis(len(values), name), *entry_axes)
    )


def _joined(walked: _Walked) -> Numbers:
    """Numbers whose axes are labelled, or one."""
    axes = walked.axes
    n = walked.values.size
    # Lists within a list, as of JSON, are axes of the layout.
    if len({axis.label for axis in axes}) < len(axes):
        axes = tuple(Axis(axis.size) for axis in axes)
        return Numbers(walked.values, axes)
    # Axes that nothing names are one, in the order of the message.
    has_labels = any(axis.label.lower() in (*ROW_LABELS, *COL_LABELS) for axis in axes)
    if len(axes) < 2 or not has_labels:
        # The last axis may be x, y and z.
        n_channels = 1
        if len(axes) > 1 and walked.has_channels:
            n_channels = axes[-1].size
        axes = (Axis(n, "taxels"),)
        if n_channels in (2, len(XYZ)):
            axes = (Axis(n // n_channels, "taxels"), Axis(n_channels, "channel"))
    return Numbers(walked.values.reshape([axis.size for axis in axes]), axes)


def _last_name(path: str) -> str:
    """The last name of a path."""
    return path.rpartition(".")[2].partition("[")[0].lower()


def _paths(message: Message) -> list[str]:
    paths = []
    for name, value in message.items():
        if name == "header":
            continue
        # A message of many members may have any number of paths.
        for ending in _endings(value, False):
            paths.append(name + ending)
            if len(paths) >= MAX_PATHS:
                return paths
    return paths


def _endings(value: Any, is_listed: bool) -> Iterator[str]:
    """What follows the name of a member in the paths of its lists of numbers; `is_listed`: it is a
    member of the entries of a list, so that a number is enough.
    """
    if isinstance(value, np.ndarray) and value.dtype.names:
        yield from ("[]" + ending for ending in _of_dtype(value.dtype))
    elif isinstance(value, np.ndarray):
        if value.dtype.kind in "iuf":
            yield "[]"
    elif isinstance(value, Message) and value.kind == CLOUD:
        yield from (f".{name}" for name in fields_of(value, readings=True))
    elif isinstance(value, Message) and value.kind in KINDS:
        yield ""
    elif isinstance(value, Message):
        for name, member in value.items():
            if name != "header":
                for ending in _endings(member, is_listed):
                    yield f".{name}{ending}"
    elif isinstance(value, list) and value:
        endings = list(_endings(value[0], True))
        # Numbers beside lists are about the entry: it is a skin, and no taxel.
        endings_of_lists = [ending for ending in endings if "[]" in ending]
        for ending in endings_of_lists or endings:
            yield from _of_list(len(value), ending, value[0])
    elif is_listed and isinstance(value, int | float) and not isinstance(value, bool):
        yield ""


def _of_list(n: int, ending: str, entry: Any) -> Iterator[str]:
    """The paths into a list of messages: all entries, and each of them where it may be a skin."""
    # A path without a list in its ending holds one number of each entry.
    is_frame = isinstance(entry, Message) and entry.kind in KINDS
    if "[]" not in ending and not is_frame:
        yield "[]" + ending
        return
    yield from (f"[{k}]{ending}" for k in range(min(n, MAX_LISTED)))
    if n > 1:
        yield "[]" + ending


def _of_dtype(dtype: np.dtype[Any]) -> Iterator[str]:
    """The numbers in messages of one size."""
    for name in dtype.names or ():
        member = dtype[name]
        if member.names:
            yield from (f".{name}{ending}" for ending in _of_dtype(member))
        elif member.subdtype is not None:
            if member.subdtype[0].kind in "iuf":
                yield f".{name}[]"
        elif member.kind in "iuf":
            yield f".{name}"


def only_channel(paths: Iterable[str], channel: str) -> list[str]:
    """Of paths that end with x, y and z beside each other, that of the channel, or z."""
    all_paths = list(paths)
    letter_wanted = NORMAL
    if channel.lower() in XYZ:
        letter_wanted = channel.lower()

    chosen_paths = []
    for path in all_paths:
        name, brackets = ENDING.fullmatch(path).groups()  # type: ignore[union-attr]
        stem = name[:-1]
        letter = name[-1:]
        axes: tuple[str, ...] = XYZ
        if not letter.islower():
            axes = tuple(axis.upper() for axis in XYZ)
        # Only where all three stand beside each other are they the axes of a force.
        siblings = {stem + axis + brackets for axis in axes}
        is_of_three = letter in axes and siblings.issubset(all_paths)
        if not is_of_three or letter.lower() == letter_wanted:
            chosen_paths.append(path)
    return chosen_paths
