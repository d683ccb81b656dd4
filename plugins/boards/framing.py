"""Frames in bytes: where one begins and ends, and if it is whole. The payload is not interpreted.

A frame is

    start bytes | sequence number | skipped bytes | payload | bytes after it | checksum | end bytes

of which all but the payload may be absent. Its length is fixed, or stated in it. Numbers may stand
among the skipped bytes, and those after the payload. `FrameParser` finds frames in a
stream of bytes, of which some may be lost, extra or wrong:

- with a CRC of 16 bits or more, a frame is accepted when its CRC is right;
- with a weaker checksum or none, it is accepted when the start bytes of the next frame follow its
  last byte. After an error two frames in a row must fit so, and no other place in the same stretch
  of bytes may fit as well: the start bytes can occur among the readings.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

from .checksums import CHECKSUMS, Checksum

LATE = 16
"""A sequence number that is lower than the last one by at most so many is of a frame that came too
late; by more, of a board that was started again. Chosen: packets overtake few others."""
MAX_MISSING = 1 << 20
"""A number that is higher by more is forged, or of a board that was started again: no frame is
counted as missing. Chosen: 17 minutes at 1 kHz."""
MAX_CHECKS = 64
"""Places that are tried after an error for each call, and eight more for each frame's length of
bytes; chosen, so that no bytes take much longer to parse than frames do."""
MAX_MORE = 4096
"""Most bytes after the payload beyond the fixed ones, of frames that state their length; chosen."""

Raw: TypeAlias = "bytes | bytearray | memoryview"


@dataclass
class Counts:
    """What came: frames accepted; frames whose checksum, end or length was wrong, or that lacked a
    part; that never came, by their numbers; that came twice or after a later one; bytes in no
    accepted frame.
    """

    frames: int = 0
    bad_frames: int = 0
    missing_frames: int = 0
    late_frames: int = 0
    dropped_bytes: int = 0


@dataclass(frozen=True)
class Frame:
    """An accepted frame: payload, sequence number if it has one, bytes of the stream up to its end,
    stamp on the board's clock, number of its first reading.
    """

    payload: bytes
    sequence: int | None
    end: int
    stamp: int = 0
    first: int = 0


@dataclass(frozen=True)
class Field:
    """A number in a frame: place of its first byte, and its length."""

    at: int
    n_bytes: int


@dataclass(frozen=True)
class Framing:
    """The parts of a frame.

    `start`, `end`: fixed bytes, b"" for none; `wild`: places in `start`, not the first, of any
    byte. `sequence_bytes`: length of the sequence number, 0 (none), 1, 2 or 4; `sequence_at`: its
    place, if not after `start`. `skip`, `after`: bytes before and after the payload that are not
    used. `stamp`, `first`, `length`: places of the stamp, of the number of the first reading (of
    frames that hold a piece of the skin), of the number of bytes from the payload to the checksum,
    where it varies. `checksum`: a name of `CHECKSUMS`, of all from `checksum_from` to the payload.
    `confirm`: False to accept a frame with a weak checksum or none at its last byte; one that lost
    bytes may then be accepted with bytes of the next in their place.
    """

    payload_bytes: int
    start: bytes = b""
    end: bytes = b""
    sequence_bytes: int = 0
    skip: int = 0
    checksum: str = "none"
    checksum_from: Literal["start", "sequence", "payload"] = "sequence"
    byte_order: Literal["little", "big"] = "little"
    confirm: bool = True
    wild: frozenset[int] = frozenset()
    sequence_at: int | None = None
    after: int = 0
    stamp: Field | None = None
    first: Field | None = None
    length: Field | None = None

    @cached_property
    def n_bytes(self) -> int:
        """Length of a frame; the least, where it varies."""
        n = self.payload_at + self.payload_bytes + self.after
        return n + self._check.n_bytes + len(self.end)

    def size(self, raw: Raw) -> int:
        """Length of the frame that these bytes begin; the least, where they state none allowed."""
        n = self.n_bytes
        least_length = self.payload_bytes + self.after
        if self.length is None or len(raw) < n:
            return n

        # The stated length counts from the payload to the checksum.
        excess = _value(raw, self.length, self.byte_order) - least_length
        # A forged length must not make the parser wait for bytes that never come.
        if not 0 < excess <= MAX_MORE:
            return n
        return n + excess

    @cached_property
    def sequence(self) -> Field | None:
        """The sequence number."""
        if not self.sequence_bytes:
            return None
        at = self.sequence_at
        if at is None:
            at = len(self.start)
        return Field(at, self.sequence_bytes)

    @cached_property
    def prefix(self) -> bytes:
        """The start bytes to the first that is not fixed."""
        return self.start[: min(self.wild, default=None)]

    @property
    def is_strong(self) -> bool:
        """True if a frame can be believed for its checksum alone."""
        return self._check.is_strong

    @property
    def _check(self) -> Checksum:
        return CHECKSUMS[self.checksum]

    @cached_property
    def payload_at(self) -> int:
        """Place of the payload."""
        at = len(self.start) + self.skip
        # A number at a place of its own is among the skipped bytes.
        if self.sequence_at is None:
            at += self.sequence_bytes
        return at

    def encode(self, payload: bytes, sequence: int = 0) -> bytes:
        """A frame as a board sends it; other numbers and bytes that are not used are 0."""
        n_head = self.payload_at - len(self.start)
        body = bytearray(self.start + bytes(n_head) + payload + bytes(self.after))
        length = len(payload) + self.after
        for field, value in ((self.length, length), (self.sequence, sequence)):
            if field is not None:
                # As a counter on the board does, numbers begin at 0 again.
                modulus = 1 << 8 * field.n_bytes
                raw = (value % modulus).to_bytes(field.n_bytes, self.byte_order)
                body[field.at : field.at + field.n_bytes] = raw

        check = self._check
        # The checksum is computed last: it covers the numbers, too.
        value = check.compute(bytes(body[self._covered_from :]))
        return bytes(body) + value.to_bytes(check.n_bytes, self.byte_order) + self.end

    @cached_property
    def _covered_from(self) -> int:
        starts = {
            "start": 0,
            "sequence": len(self.start),
            "payload": self.payload_at,
        }
        return starts[self.checksum_from]

    def is_whole(self, raw: bytes) -> bool:
        """True if `size` bytes are a frame: start, length, checksum and end are right."""
        # Fixed bytes are compared first: they cost least.
        if not (raw.startswith(self.prefix) and raw.endswith(self.end)):
            return False
        for k in range(len(self.prefix), len(self.start)):
            if k not in self.wild and raw[k] != self.start[k]:
                return False

        n_check = self._check.n_bytes
        at = len(raw) - len(self.end) - n_check
        length = self._number(raw, self.length)
        if length is not None and length != at - self.payload_at:
            return False
        checksum = _value(raw, Field(at, n_check), self.byte_order)
        return self._check.compute(raw[self._covered_from : at]) == checksum

    def frame(self, raw: bytes, end: int) -> Frame:
        """The whole frame of these bytes; `end` as of `Frame`."""
        return Frame(
            payload=raw[self.payload_at : self.payload_at + self.payload_bytes],
            sequence=self._number(raw, self.sequence),
            end=end,
            stamp=self._number(raw, self.stamp) or 0,
            first=self._number(raw, self.first) or 0,
        )

    def _number(self, raw: Raw, field: Field | None) -> int | None:
        """The number in a field; None if frames have no such field."""
        if field is None:
            return None
        return _value(raw, field, self.byte_order)


def _value(raw: Raw, field: Field, byte_order: Literal["little", "big"]) -> int:
    return int.from_bytes(raw[field.at : field.at + field.n_bytes], byte_order)


class Sequence:
    """Counts the frames that are missing between sequence numbers of `n_bytes` bytes."""

    def __init__(self, n_bytes: int, counts: Counts) -> None:
        self._modulus = 1 << 8 * n_bytes
        self._last: int | None = None
        self._counts = counts

    def reset(self) -> None:
        """Expect any number next: the board was unplugged."""
        self._last = None

    def admit(self, number: int | None) -> bool:
        """Count a frame by its number; False for one that came before, or after a later one."""
        # Frames without a number cannot be counted as missing.
        if number is None:
            return True
        if self._last is None:
            self._last = number
            return True

        # Numbers begin at 0 again.
        ahead = (number - self._last) % self._modulus
        behind = self._modulus - ahead
        if ahead == 0 or behind <= min(LATE, self._modulus // 8):
            self._counts.late_frames += 1
            return False

        self._last = number
        # Farther ahead than half a turn, it may as well be behind.
        if ahead <= min(self._modulus // 2, MAX_MISSING):
            self._counts.missing_frames += ahead - 1
        return True


class FrameParser:
    """Finds the frames in a stream of bytes, however it is cut; `framing` has start bytes."""

    def __init__(self, framing: Framing, counts: Counts | None = None) -> None:
        if not framing.start:
            raise ValueError("a stream needs start bytes")
        self.framing = framing
        self.counts = Counts() if counts is None else counts
        self._sequence = Sequence(framing.sequence_bytes, self.counts)
        self._buffer = bytearray()
        # Place of the buffer in the stream.
        self._offset = 0
        # True if a frame begins at the begin of the buffer.
        self._in_step = False

    @property
    def n_waiting(self) -> int:
        """Bytes that are neither dropped nor part of an accepted frame yet."""
        return len(self._buffer)

    def reset(self) -> None:
        """Drop what is waiting: the stream was interrupted."""
        self._drop(len(self._buffer))
        self._in_step = False
        self._sequence.reset()

    def feed(self, data: bytes) -> list[Frame]:
        """Add bytes to the stream; return the frames that are accepted now, in order."""
        self._buffer += data
        # A strong checksum needs one frame to find the place again, a weak one two.
        search = self._search_one if self.framing.is_strong else self._search_two
        checks = MAX_CHECKS + 8 * len(self._buffer) // self.framing.n_bytes
        frames: list[Frame] = []
        # After an error, bytes are searched for the next frame, a bounded number of times.
        while True:
            if self._in_step:
                if not self._take(frames):
                    return frames
            elif not checks:
                self._drop(max(0, len(self._buffer) - len(self.framing.start) + 1))
                return frames
            else:
                checks -= 1
                if not search():
                    return frames

    def _take(self, frames: list[Frame]) -> bool:
        """Accept or refuse the frame at the begin; False if more bytes must come first."""
        framing = self.framing
        buffer = self._buffer
        n = framing.size(buffer)
        n_start = len(framing.prefix)

        # A weak frame is confirmed by the start of the next one.
        needs_next = framing.confirm and not framing.is_strong
        n_needed = n
        if needs_next:
            n_needed += n_start
        if len(buffer) < n_needed:
            return False
        is_confirmed = not needs_next or buffer[n : n + n_start] == framing.prefix

        raw = bytes(buffer[:n])
        if not (is_confirmed and framing.is_whole(raw)):
            self.counts.bad_frames += 1
            self._in_step = False
            # The search for a strong frame would find this one again.
            if framing.is_strong:
                self._drop(1)
            return True

        del buffer[:n]
        self._offset += n
        frame = framing.frame(raw, self._offset)
        if self._sequence.admit(frame.sequence):
            self.counts.frames += 1
            frames.append(frame)
        else:
            self.counts.dropped_bytes += n
        return True

    def _search_one(self) -> bool:
        """Drop what is before the next frame with a right checksum."""
        framing = self.framing
        if not self._find_start():
            return False
        n = framing.size(self._buffer)
        if len(self._buffer) < n:
            return False

        if framing.is_whole(bytes(self._buffer[:n])):
            self._in_step = True
        else:
            self._drop(1)
        return True

    def _search_two(self) -> bool:
        """Drop what is before the next two frames in a row, where no other two fit as well."""
        framing = self.framing
        buffer = self._buffer
        n = framing.n_bytes
        start = framing.prefix
        if not self._find_start() or len(buffer) < 2 * n + len(start):
            return False

        fitting: list[int] = []
        n_tried = 0
        at = 0
        # Within one length of a frame all places are tried, to see that only one fits.
        while 0 <= at < n and len(fitting) < 2 and n_tried < MAX_CHECKS:
            if buffer.startswith(start, at + n):
                n_tried += 1
                if framing.is_whole(bytes(buffer[at : at + n])):
                    fitting.append(at)
            at = buffer.find(start, at + 1)

        # Start bytes may occur among the readings: two places that fit are as good as none.
        if len(fitting) == 1 and n_tried < MAX_CHECKS:
            self._drop(fitting[0])
            self._in_step = True
        else:
            self._drop(n)
        return True

    def _find_start(self) -> bool:
        """Drop what is before the next start bytes, or what may be their begin."""
        # The last bytes may be the begin of start bytes.
        place = self._buffer.find(self.framing.prefix)
        if place < 0:
            self._drop(max(0, len(self._buffer) - len(self.framing.prefix) + 1))
        else:
            self._drop(place)
        return place >= 0

    def _drop(self, n: int) -> None:
        del self._buffer[:n]
        self._offset += n
        self.counts.dropped_bytes += n


class PacketParser:
    """Finds the frames in packets that hold whole frames alone; what is not is counted."""

    def __init__(self, framing: Framing, counts: Counts | None = None) -> None:
        self._framing = framing
        self.counts = Counts() if counts is None else counts
        self._sequence = Sequence(framing.sequence_bytes, self.counts)
        self._n_bytes = 0

    def reset(self) -> None:
        """Expect any number next: the board was unplugged."""
        self._sequence.reset()

    def feed(self, packet: bytes) -> list[Frame]:
        """Return the frames of a packet that are accepted, in order."""
        framing = self._framing
        counts = self.counts
        self._n_bytes += len(packet)

        # A packet that ends within a frame is dropped whole.
        raws = []
        unparsed = memoryview(packet)
        n = 0
        while unparsed:
            n = framing.size(unparsed)
            raws.append(bytes(unparsed[:n]))
            unparsed = unparsed[n:]
        if not packet or len(raws[-1]) < n:
            counts.bad_frames += 1
            counts.dropped_bytes += len(packet)
            return []

        frames = []
        for raw in raws:
            # One damaged frame costs itself: the others of its packet are used.
            is_whole = framing.is_whole(raw)
            frame = framing.frame(raw, self._n_bytes)
            if is_whole and self._sequence.admit(frame.sequence):
                counts.frames += 1
                frames.append(frame)
            else:
                counts.bad_frames += not is_whole
                counts.dropped_bytes += len(raw)
        return frames
