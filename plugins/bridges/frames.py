"""Messages of ROS as frames of readings, of recordings and of topics."""

import struct
from typing import Any, NamedTuple

import numpy as np

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout.layout import Layout, UnstatedError
from sparseskin.nodes.sensor.layout.times import is_time_name, named_unit

from .cdr import CLOUD
from .messages.decoding import ENCAPSULATION_BYTES, ORDERS, Decoder, Message
from .messages.definitions import HEADER, TIME, Definitions
from .messages.fields import numbers_at, only_channel, paths_of, value_at
from .messages.grids import KINDS, EmptyMessageError, Numbers, fields_of
from .messages.json_messages import message_of


class OtherFrameError(SourceError):
    """A message of another frame than the stated one."""


LOG = "log"
NONE = "none"
"""Values of `Layout.time`: the times at which messages were recorded; no times."""
STAMP = "header.stamp"
SOURCES = (
    "sensor_id",
    "sensor_name",
    "device_id",
    "board_id",
    "module_id",
    "skin_id",
    "side",
    "hand",
    "sensor",
    "device",
    "board",
    "module",
    "skin",
    "patch",
    "finger",
    "frame_id",
)
"""Members of messages that state which skin they are of."""
NUMBERED = ("id", "addr", "address", "port", "node")
"""Members of messages that may state it, or count messages."""
MAX_SKINS = 8
"""Most skins that send on one topic by turns; chosen."""


class Received(NamedTuple):
    """A message that was read: its numbers, its time in the unit of the reader, None where it has
    none, the frame that its header names, and the value of a member of `NUMBERED`, "" where there
    is none.
    """

    numbers: Numbers
    time: int | float | None
    frame_id: str
    number: str = ""


class Turns:
    """Notices that the values of a member of `NUMBERED` take turns, as those of several skins."""

    def __init__(self) -> None:
        self._values: set[str] = set()
        self._last = ""

    def add(self, value: str) -> bool:
        """Add the value of a message; returns True if it comes again behind others."""
        if value == self._last or len(self._values) > MAX_SKINS:
            return False
        self._last = value
        comes_again = value in self._values
        self._values.add(value)
        return comes_again


class Alike:
    """Messages with all bytes of an example, beside the stamp of the header and the numbers. These
    stand in the same places, and nothing else is decoded again.
    """

    def __init__(
        self,
        example: bytes,
        received: Received,
        is_grid: bool,
        stamp: str,
        stamp_at: int,
    ) -> None:
        self._received = received
        self._n_bytes = len(example)
        self._unpack = struct.Struct(stamp).unpack_from
        self._stamp_at = stamp_at
        #: Bytes between begin and stamp, stamp and numbers, numbers and end, which are the same.
        self._same: list[tuple[slice, bytes]] = []
        address = np.frombuffer(example, np.uint8).ctypes.data
        values = received.numbers.values
        self._values_at = values.ctypes.data - address
        low, high = np.lib.array_utils.byte_bounds(values)
        stamp_end = stamp_at + struct.calcsize(stamp)
        # Numbers that are gathered from several lists stand elsewhere; between those of a list of
        # records may stand the names of their taxels.
        is_dense = high - low == values.nbytes
        is_within = stamp_end <= low - address <= high - address <= len(example)
        self.is_possible = is_within and (is_dense or is_grid)
        for begin, end in (
            (0, stamp_at),
            (stamp_end, low - address),
            (high - address, len(example)),
        ):
            place = slice(max(begin, 0), max(end, 0))
            self._same.append((place, example[place]))

    def received(self, data: bytes) -> Received | None:
        """What a message holds; None if it has to be decoded."""
        if len(data) != self._n_bytes:
            return None
        for place, same in self._same:
            if data[place] != same:
                return None
        (values, axes), time, frame_id, number = self._received
        stamp = self._unpack(data, self._stamp_at)
        if stamp:
            time = stamp[-2] * 1_000_000_000 + stamp[-1] or None
        view = np.ndarray(
            values.shape, values.dtype, data, self._values_at, values.strides
        )
        return Received(Numbers(view, axes), time, frame_id, number)


class MessageReader:
    """Reads messages of one type: the numbers at a field, and their times.

    `field` is "" for an image, an array, or a point cloud with one field of readings. Raises
    SourceError if the definition of the type is not known, or the field of times is none.
    """

    def __init__(
        self, definitions: Definitions | None, kind: str, layout: Layout
    ) -> None:
        self.kind = kind
        self.field = layout.field
        #: Unit of the times; "" if nothing states it.
        self.time_unit = "ns"
        #: False of messages in JSON, whose numbers have no types.
        self.has_types = definitions is not None
        self._decode = message_of
        if definitions is not None:
            self._decode = Decoder(definitions, kind).decode
        self._is_cdr = definitions is not None and definitions.ros == 2
        self._layout = layout
        self._frame_id = layout.frame_id
        self._alike: Alike | None = None
        #: Where the times stand in a message; "" if they are those of the recording; None before
        #: the first message shows it.
        self._time_path: str | None = None
        self._has_header = False

    @property
    def time_path(self) -> str:
        """Where the times stand in a message; "" if they are those of the recording."""
        return self._time_path or ""

    @property
    def _is_header_time(self) -> bool:
        return self._time_path == STAMP

    def decode(self, data: bytes) -> Message:
        """Read a message. Raises EmptyMessageError if it has no byte, SourceError if it is none."""
        if not data:
            raise EmptyMessageError("holds no byte")
        message = self._decode(data)
        if self._time_path is None:
            self._time_path = self._path_of_times(message)
        return message

    def _path_of_times(self, message: Message) -> str:
        """Where the times stand in messages like one."""
        # Lists have no single value that could be a time or a name.
        stamps = []
        numbers = []
        for name, value in message.items():
            if isinstance(value, Message) and value.kind == TIME:
                stamps.append(name)
            elif isinstance(value, int | float) and is_time_name(name):
                numbers.append(name)
        header = message.get("header")
        self._has_header = isinstance(header, Message) and header.kind == HEADER
        self._begins_with_header = next(iter(message), "") == "header"

        if self._layout.time in (LOG, NONE):
            return ""
        if self._layout.time:
            return self._layout.time
        if self._has_header:
            return STAMP
        # A message without a header may state its time in a member of its own. Of several, it is
        # not clear which is meant.
        times = stamps or numbers
        return times[0] if len(times) == 1 else ""

    def read_frame(self, data: bytes) -> Received:
        """Read the numbers of a message. Raises EmptyMessageError if it holds none,
        OtherFrameError if its frame is not the stated one, SourceError if it is malformed.
        """
        received = self._alike.received(data) if self._alike else None
        if received is not None:
            return received
        message = self.decode(data)
        self.check_frame(message)
        numbers = numbers_at(message, self.field)
        received = self.received(numbers, message)
        self._alike = self._alike_of(data, received)
        return received

    def _alike_of(self, data: bytes, received: Received) -> Alike | None:
        """Messages like one; None if the place of their times is not known."""
        if not self.has_types:
            return None
        stamp = ""
        stamp_at = 0
        if self._is_header_time and self._begins_with_header:
            # ROS 1 counts messages before the stamp, ROS 2 states the order of bytes. Seconds are
            # signed, as rosbags reads those of both.
            stamp = "<IiI"
            if self._is_cdr:
                stamp = f"{ORDERS[data[:2]]}iI"
                stamp_at = ENCAPSULATION_BYTES
        elif self.time_path:
            return None
        alike = Alike(data, received, self.kind in KINDS, stamp, stamp_at)
        return alike if alike.is_possible else None

    def received(self, numbers: Numbers, message: Message) -> Received:
        """The numbers of a message, and what it states of them."""
        number = ""
        # Whether it tells skins apart or counts messages shows in several messages: see `Turns`.
        for name in NUMBERED:
            if isinstance(message.get(name), int | str):
                number = str(message[name])
        return Received(numbers, self.time_of(message), self.frame_of(message), number)

    def frame_of(self, message: Message) -> str:
        """The skin that a member of a message names, or else the frame that its header does; ""
        where there is none.
        """
        for name in SOURCES:
            if isinstance(message.get(name), int | str):
                return str(message[name])
        if not self._has_header:
            return ""
        return str(message["header"]["frame_id"])

    def check_frame(self, message: Message) -> None:
        """Raise OtherFrameError if the frame of a message is not the stated one."""
        numbers = [str(message[name]) for name in NUMBERED if name in message]
        if self._frame_id and self._frame_id not in (self.frame_of(message), *numbers):
            raise OtherFrameError(
                f"frame_id {printable(self.frame_of(message)[:40])!r}"
            )

    def time_of(self, message: Message) -> int | float | None:
        if not self.time_path:
            return None
        if self._is_header_time:
            stamp: Any = message["header"]["stamp"]
        else:
            stamp = value_at(message, self.time_path)
        if isinstance(stamp, Message):
            # 0: the header has no stamp.
            return stamp["sec"] * 1_000_000_000 + stamp["nanosec"] or None
        self.time_unit = self._layout.time_unit or named_unit(self.time_path)
        number: int | float = stamp
        return number


def fields_that_fit(message: Message, layout: Layout) -> dict[str, Numbers]:
    """The fields of a message that can be frames, by their path, and their numbers: those of the
    stated shape, where one is stated. Raises SourceError if the message is a malformed frame.
    """
    # A point cloud has several fields; images and arrays are one frame each.
    if message.kind == CLOUD:
        names = only_channel(fields_of(message, readings=True), layout.channel)
        fields = {name: numbers_at(message, name) for name in names}
    elif message.kind in KINDS:
        fields = {"": numbers_at(message, "")}
    else:
        fields = paths_of(message, layout.channel)
    # Where none has the stated number of taxels, all are named in the error.
    n = layout.n_stated
    fitting = {field: fields[field] for field in fields if _fits(fields[field], n)}
    return fitting or fields


def choose_field(message: Message, layout: Layout, where: str) -> str:
    """The field that holds the readings: the stated one, or the only one that can. Raises
    SourceError if there is none, UnstatedError if there are several.
    """
    if layout.field:
        return layout.field

    fitting = fields_that_fit(message, layout)
    if not fitting:
        raise SourceError(f"{where}: {message.kind} holds no list of numbers")
    if len(fitting) > 1:
        texts = [f"{printable(name)} {size_text(fitting[name])}" for name in fitting]
        fault = f"{message.kind} holds {len(fitting)} fields of numbers"
        fault = f"{fault}: {', '.join(texts)[:300]}"
        # An interactive program offers these options instead of the error.
        options = [{"field": field} for field in fitting]
        raise UnstatedError(f"{where}: {fault}; state field", *options)
    return next(iter(fitting))


def size_text(numbers: Numbers) -> str:
    """Sizes of the axes of a message: "(4 x 3)"."""
    sizes = " x ".join(str(axis.size) for axis in numbers.axes)
    return f"({sizes})"


def _fits(numbers: Numbers, n_stated: int | None) -> bool:
    """True if a frame of so many taxels can be read from the numbers: a channel is their last
    axis.
    """
    n = numbers.values.size
    n_channels = numbers.axes[-1].size if len(numbers.axes) > 1 else 1
    return n_stated in (None, n, n // n_channels)
