"""Bytes of messages: CDR, the form of ROS 2, and that of ROS 1.

No code is made of a definition, and no length that a message states is used before it is compared
with the bytes that there are. Lists of numbers, and of messages of one size, are views of these.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError

from .definitions import BASES, MAX_COUNT, SEQUENCE, STRING, Definitions, Member

ENCAPSULATION_BYTES = 4
ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}
"""Order of bytes by the begin of a message in CDR."""
CHARS = {
    "?": "?",
    "i1": "b",
    "u1": "B",
    "i2": "h",
    "u2": "H",
    "i4": "i",
    "u4": "I",
    "i8": "q",
    "u8": "Q",
    "f4": "f",
    "f8": "d",
}
"""Format of `struct` of each dtype."""
MAX_FIXED_BYTES = 1 << 26
"""Largest message of one size; chosen: more than any message holds."""
MAX_DEPTH = 32
SPARE_BYTES = 64
"""Messages without members count as a byte each, that they do not have in ROS 1: so many may."""
PHASES = 8
"""Largest alignment of CDR, bytes: the places of members depend on the begin of their message in
so many."""

Buffer = bytes | memoryview
Read = Callable[[Buffer, int], tuple[Any, int]]
"""Reads a value from a byte on; the value, and the byte behind it."""


class Message(dict[str, Any]):
    """A message that was read: its members, and the name of its type."""

    __slots__ = ("kind",)

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind


class Fixed(NamedTuple):
    """A type whose messages have one size, from a byte on: their dtype without padding behind, and
    bytes from one to the next.
    """

    dtype: np.dtype[Any]
    stride: int


class Decoder:
    """Reads messages of one type. Raises SourceError if its definition is not known, or nested
    within itself.
    """

    def __init__(self, definitions: Definitions, kind: str) -> None:
        self._kind = kind
        self._is_cdr = definitions.ros == 2
        # Each message of ROS 2 states its order; those of ROS 1 are little endian.
        orders = list(ORDERS.values()) if self._is_cdr else ["<"]
        self._read: dict[str, Read] = {}
        for order in orders:
            readers = _Readers(definitions, order)
            self._read[order] = readers.message(kind)
        self._least_bytes = readers.least_bytes(kind)

    def decode(self, data: bytes) -> Message:
        """Read the bytes of a message. Raises SourceError if they are none."""
        body: Buffer = data
        order = "<"
        if self._is_cdr:
            if data[:2] not in ORDERS:
                raise SourceError(
                    f"no {self._kind}: encapsulation {data[:2].hex() or 'missing'}"
                )
            order = ORDERS[data[:2]]
            body = memoryview(data)[ENCAPSULATION_BYTES:]

        # Lists of fixed length within each other may ask for any amount of memory.
        if self._least_bytes > len(body) + SPARE_BYTES:
            raise SourceError(f"no {self._kind}: it has {len(body)} bytes")
        try:
            message, _ = self._read[order](body, 0)
        except (struct.error, ValueError, TypeError, IndexError) as error:
            raise SourceError(
                f"no {self._kind}: it ends before its last member"
            ) from error
        assert isinstance(message, Message)
        return message


class _Readers:
    """Readers of the types of some definitions, in one order of bytes."""

    def __init__(self, definitions: Definitions, order: str) -> None:
        self._definitions = definitions
        self._order = order
        self._is_cdr = definitions.ros == 2
        self._phases = PHASES if self._is_cdr else 1
        self._messages: dict[str, Read] = {}
        self._dtypes: dict[tuple[str, int], np.dtype[Any] | None] = {}
        self._least: dict[str, int] = {}
        self._open: list[str] = []
        self._count = _scalar(order, "u4", self._is_cdr)

    def least_bytes(self, kind: str) -> int:
        """Least size of a value of a type, bytes; at least 1."""
        if kind in BASES:
            return np.dtype(BASES[kind]).itemsize
        if kind == STRING:
            return 4
        if kind not in self._least:
            total = 0
            for member in self._definitions.members(kind):
                if member.n_entries == SEQUENCE:
                    total += 4
                elif member.n_entries is None:
                    total += self.least_bytes(member.kind)
                else:
                    total += member.n_entries * self.least_bytes(member.kind)
            self._least[kind] = max(1, total)
        return self._least[kind]

    def message(self, kind: str) -> Read:
        """The reader of a type of messages."""
        if kind in self._messages:
            return self._messages[kind]
        # A definition may contain itself, or be nested without end.
        if kind in self._open or len(self._open) >= MAX_DEPTH:
            raise SourceError(f"the definition of {printable(kind)} is nested too deep")

        # Types within which this one is read, so that none is nested within itself.
        self._open.append(kind)
        definition = self._definitions.members(kind)
        members = [(member.name, self._member(member)) for member in definition]
        self._open.pop()

        def read(data: Buffer, at: int) -> tuple[Any, int]:
            message = Message(kind)
            for name, read_member in members:
                message[name], at = read_member(data, at)
            return message, at

        self._messages[kind] = read
        return read

    def _member(self, member: Member) -> Read:
        kind = member.kind
        count = member.n_entries
        if count is not None and count > MAX_COUNT:
            raise SourceError(f"{printable(member.name)}: a list of {count} entries")

        if kind in BASES:
            read_value = _scalar(self._order, BASES[kind], self._is_cdr)
        elif kind == STRING:
            read_value = self._text()
        elif "/" in kind:
            read_value = self.message(kind)
        else:
            raise SourceError(
                f"{printable(member.name)}: {printable(kind)} is not read"
            )

        if count is None:
            return read_value
        if kind in BASES:
            return self._numbers(np.dtype(self._order + BASES[kind]), count)
        if kind == STRING:
            return self._list(kind, read_value, count)
        return self._structs(kind, read_value, count)

    def _text(self) -> Read:
        read_count = self._count
        # CDR ends a text with a zero.
        n_end_bytes = 1 if self._is_cdr else 0

        def read(data: Buffer, at: int) -> tuple[str, int]:
            n_bytes, at = read_count(data, at)
            stop = at + n_bytes
            if stop > len(data):
                raise SourceError("a text is longer than its message")
            text = bytes(data[at : max(at, stop - n_end_bytes)])
            return text.decode("utf-8", "replace"), stop

        return read

    def _length(
        self, count: int, least_bytes: int
    ) -> Callable[[Buffer, int], tuple[int, int]]:
        """The reader of the length of a list, which is compared with the bytes that follow."""
        read_count = self._count

        def read(data: Buffer, at: int) -> tuple[int, int]:
            n = count
            if n == SEQUENCE:
                n, at = read_count(data, at)
            # No length is believed before it is compared with the bytes that follow.
            if n * least_bytes > len(data) - at + SPARE_BYTES or n > MAX_COUNT:
                raise SourceError(f"a list of {n} entries is longer than its message")
            return n, at

        return read

    def _numbers(self, dtype: np.dtype[Any], count: int) -> Read:
        read_length = self._length(count, dtype.itemsize)
        align = dtype.itemsize if self._is_cdr else 1

        def read(data: Buffer, at: int) -> tuple[npt.NDArray[Any], int]:
            n, at = read_length(data, at)
            # An empty list is not aligned.
            if n:
                at = (at + align - 1) & -align
            # A view: numpy refuses one beyond the end of the bytes.
            numbers = np.ndarray((n,), dtype, data, at)
            return numbers, at + n * dtype.itemsize

        return read

    def _list(self, kind: str, read_value: Read, count: int) -> Read:
        read_length = self._length(count, self.least_bytes(kind))

        def read(data: Buffer, at: int) -> tuple[list[Any], int]:
            n, at = read_length(data, at)
            values = []
            for _ in range(n):
                value, at = read_value(data, at)
                values.append(value)
            return values, at

        return read

    def _structs(self, kind: str, read_value: Read, count: int) -> Read:
        """The reader of a list of messages, whose numbers are one array where all have one size."""
        read_length = self._length(count, self.least_bytes(kind))
        read_list = self._list(kind, read_value, count)
        phases = self._phases
        layouts = [self._fixed(kind, phase) for phase in range(phases)]
        align = self._first_align(kind)
        if not any(layouts):
            return read_list

        def read(data: Buffer, at: int) -> tuple[Any, int]:
            begin = at
            n, at = read_length(data, at)
            at = (at + align - 1) & -align
            # The places depend on where the list begins, as alignment counts from the message.
            fixed = layouts[at % phases]
            if fixed is None or not n:
                return read_list(data, begin)
            stop = at + (n - 1) * fixed.stride + fixed.dtype.itemsize
            records = np.ndarray((n,), fixed.dtype, data, at, (fixed.stride,))
            return records, stop

        return read

    def _first_align(self, kind: str) -> int:
        """Alignment of the first number of a value."""
        if not self._is_cdr:
            return 1
        if "/" not in kind:
            return np.dtype(BASES.get(kind, "u4")).itemsize
        members = self._definitions.members(kind)
        if not members:
            return 1
        return self._first_align(members[0].kind)

    def _fixed(self, kind: str, phase: int) -> Fixed | None:
        """The places of the numbers in each message of a list that begins at such a byte; None if
        they have no one size, or do not follow each other in equal steps.
        """
        dtype = self._places(kind, phase)
        if dtype is None:
            return None
        align = self._first_align(kind)
        stop = phase + dtype.itemsize
        stride = ((stop + align - 1) & -align) - phase

        # Wherever a later message of the list begins, its numbers must have the same places.
        begins = {(phase + k * stride) % self._phases for k in range(self._phases)}
        if any(self._places(kind, begin) != dtype for begin in begins):
            return None
        return Fixed(dtype, stride)

    def _places(self, kind: str, phase: int) -> np.dtype[Any] | None:
        """The dtype of a message that begins at such a byte; None if it has no one size."""
        key = (kind, phase)
        if key not in self._dtypes:
            self._dtypes[key] = self._dtype(kind, phase)
        return self._dtypes[key]

    def _dtype(self, kind: str, phase: int) -> np.dtype[Any] | None:
        # Members are laid out one after the other, each at the next multiple of its alignment.
        names: list[str] = []
        formats: list[np.dtype[Any]] = []
        offsets: list[int] = []
        at = phase
        for member in self._definitions.members(kind):
            # Texts and lists of any length have no fixed size.
            is_number = member.kind in BASES and member.n_entries != SEQUENCE
            is_message = "/" in member.kind and member.n_entries is None
            if not (is_number or is_message):
                return None

            align = self._first_align(member.kind)
            at = (at + align - 1) & -align
            dtype: np.dtype[Any] | None = None
            if is_message:
                dtype = self._places(member.kind, at % self._phases)
            else:
                dtype = np.dtype(self._order + BASES[member.kind])
            if dtype is not None and member.n_entries is not None:
                # Compared first: a dtype of this size would not be made.
                if member.n_entries * dtype.itemsize > MAX_FIXED_BYTES:
                    return None
                dtype = np.dtype((dtype, (member.n_entries,)))
            if dtype is None or dtype.itemsize > MAX_FIXED_BYTES:
                return None

            names.append(member.name)
            formats.append(dtype)
            offsets.append(at - phase)
            at += dtype.itemsize

        # A dtype cannot have two fields of one name.
        if not 0 < at - phase <= MAX_FIXED_BYTES or len(set(names)) < len(names):
            return None
        places: Any = {
            "names": names,
            "formats": formats,
            "offsets": offsets,
            "itemsize": at - phase,
        }
        result: np.dtype[Any] = np.dtype(places)
        return result


def _scalar(order: str, code: str, is_aligned: bool) -> Read:
    """The reader of a number."""
    dtype = np.dtype(code)
    # Compiled once for each member, as it is called for each message.
    unpack = struct.Struct(order + CHARS[code]).unpack_from
    size = dtype.itemsize
    align = size if is_aligned else 1

    def read(data: Buffer, at: int) -> tuple[Any, int]:
        at = (at + align - 1) & -align
        return unpack(data, at)[0], at + size

    return read
