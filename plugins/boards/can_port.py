"""A board on a CAN bus, opened by python-can: a frame of the skin is spread over CAN frames.

Each CAN frame holds

    index of the chunk | counter of the skin's frame | chunk of the frame

of which index and counter may be absent. With several arbitration ids, the id tells the chunk; with
one id the index does.
"""

import contextlib
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sparseskin.nodes.errors import NotHereError, SourceError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.sensor.layout.checks import shown

from .framing import Counts, Framing, PacketParser
from .ports import Arrived, Port, needed_module
from .settings import CanSettings, n_bytes_of

MAX_IDS = 4096
HIGHEST_ID = (1 << 29) - 1
"""Largest arbitration id, of the extended format."""
HIGHEST_STANDARD_ID = (1 << 11) - 1


@dataclass(frozen=True)
class Chunks:
    """How a frame is spread: arbitration ids in order of the chunks, one if the index tells them;
    number of chunks; bytes of a frame, of a chunk (the last may be shorter), of index (0 to 2) and
    counter (0 or 1).
    """

    ids: tuple[int, ...]
    n_chunks: int
    n_bytes: int
    chunk_bytes: int
    index_bytes: int
    counter_bytes: int

    def length_of(self, number: int) -> int:
        """Bytes of a chunk."""
        return min(self.chunk_bytes, self.n_bytes - number * self.chunk_bytes)


def chunks_of(settings: CanSettings, framing: Framing) -> Chunks:
    """The chunks that settings state; SourceError if they contradict each other."""
    ids = _ids_of(settings.ids)
    index_bytes = n_bytes_of(settings.index)
    counter_bytes = n_bytes_of(settings.counter)
    # Index and counter stand in each CAN frame, before the chunk.
    room = (64 if settings.fd else 8) - index_bytes - counter_bytes
    chunk_bytes = room if settings.chunk is None else settings.chunk
    if chunk_bytes > room:
        raise SourceError(
            f"chunk: {chunk_bytes} bytes do not fit beside index and counter; at most {room}"
        )

    # Rounded up: the last chunk may be shorter.
    n_chunks = -(-framing.n_bytes // chunk_bytes)
    if len(ids) == 1 and not index_bytes and n_chunks > 1:
        raise SourceError(
            "ids: one id needs index=u8, the number of the chunk in each CAN frame"
        )
    if len(ids) > 1 and len(ids) != n_chunks:
        raise SourceError(
            f"ids: {len(ids)} ids, but a frame of {framing.n_bytes} bytes has {n_chunks} chunks of "
            f"{chunk_bytes}"
        )
    if len(ids) > 1 and index_bytes:
        raise SourceError(
            "index: goes with one id; with several, the id tells the chunk"
        )
    if n_chunks > 1 << 8 * index_bytes and len(ids) == 1:
        raise SourceError(
            f"index: {settings.index} does not count to {n_chunks} chunks; index=u16"
        )
    return Chunks(
        ids, n_chunks, framing.n_bytes, chunk_bytes, index_bytes, counter_bytes
    )


def _ids_of(text: str) -> tuple[int, ...]:
    """Arbitration ids of "0x100-0x10F" or "0x100,0x102"."""
    ids: list[int] = []
    if not text:
        raise SourceError(
            "ids is not stated; add ids=0x100, or the ids in order of the readings"
        )
    for part in text.split(","):
        ends = [_id_of(end) for end in part.split("-", 1)]
        # Compared before the range is made, which may be of any size.
        if ends[-1] < ends[0] or ends[-1] - ends[0] >= MAX_IDS:
            raise SourceError(
                f"ids: {shown(part)} is no range of at most {MAX_IDS} ids that rise"
            )
        ids += range(ends[0], ends[-1] + 1)
    if len(ids) > MAX_IDS:
        raise SourceError(f"ids: {len(ids)} ids; at most {MAX_IDS}")
    if len(set(ids)) < len(ids):
        raise SourceError("ids: an id occurs twice")
    return tuple(ids)


def _id_of(text: str) -> int:
    text = text.strip()
    if not re.fullmatch(r"0[xX][0-9a-fA-F]{1,8}|[0-9]{1,9}", text):
        raise SourceError(f"ids: {shown(text)} is no arbitration id; e.g. 0x100")
    # `int(text, 0)` refuses leading zeros of decimal numbers.
    number = int(text, 0) if text[:2] in ("0x", "0X") else int(text)
    if number > HIGHEST_ID:
        raise SourceError(
            f"ids: {text} is above {HIGHEST_ID:#x}, the largest extended id"
        )
    return number


class Assembler:
    """Puts frames together from their chunks; one that lacks a chunk is counted and dropped.

    Without a counter the chunks of a frame must come in order, so that two frames cannot be mixed
    unless exactly a whole frame's length is lost between them; with one, in any order.
    """

    def __init__(self, chunks: Chunks, counts: Counts) -> None:
        self._chunks = chunks
        self._numbers = {number: k for k, number in enumerate(chunks.ids)}
        self._counts = counts
        self._parts: dict[int, bytes] = {}
        self._counter = -1

    def add(self, arbitration_id: int, data: bytes) -> bytes | None:
        """Add the data of a CAN frame, of any id; return the frame that it completes."""
        chunks = self._chunks
        # Other devices share the bus.
        if arbitration_id not in self._numbers:
            return None
        n_head = chunks.index_bytes + chunks.counter_bytes
        number = self._numbers[arbitration_id]
        if chunks.index_bytes:
            number = int.from_bytes(data[: chunks.index_bytes], "little")
        # CAN-FD pads data to one of a few lengths.
        n_needed = n_head + chunks.length_of(number)
        if number >= chunks.n_chunks or len(data) < n_needed:
            self._counts.dropped_bytes += len(data)
            return None

        counter = 0
        if chunks.counter_bytes:
            counter = data[n_head - 1]
            starts_new = counter != self._counter
        else:
            starts_new = number == 0 or number != len(self._parts)
        # A part that comes twice is of the next frame.
        if starts_new or number in self._parts:
            self.reset()
            self._counter = counter
            # The begin of this frame is lost; without a counter its parts must come in order.
            if number and not chunks.counter_bytes:
                self._counts.dropped_bytes += len(data) - n_head
                return None

        self._parts[number] = data[n_head:n_needed]
        if len(self._parts) < chunks.n_chunks:
            return None
        # With a counter they may have come in any order.
        frame = b"".join(self._parts[k] for k in range(chunks.n_chunks))
        self._parts.clear()
        self._counter = -1
        return frame

    def reset(self) -> None:
        """Drop what is waiting: the bus was interrupted, or a part is missing."""
        if self._parts:
            self._counts.bad_frames += 1
            self._counts.dropped_bytes += sum(map(len, self._parts.values()))
            self._parts.clear()


CAN_TYPE = "280"
"""ARPHRD_CAN in /sys/class/net/NAME/type. Source: linux/if_arp.h."""
MAX_FILTERS = 64
"""Most arbitration ids that the kernel is asked to filter, one by one; chosen."""
MAX_MESSAGES = 1024
"""CAN frames of one call at most; chosen, so that a flood ends."""


class CanPort(Port):
    """Frames spread over the frames of a CAN bus."""

    def __init__(
        self, address: str, settings: CanSettings, framing: Framing, counts: Counts
    ) -> None:
        super().__init__(address, settings, framing, counts)
        self._chunks = chunks_of(settings, framing)
        self._assembler = Assembler(self._chunks, counts)
        self._parser = PacketParser(framing, counts)
        self._n_errors = 0
        self._bus: Any = None

    @classmethod
    def check(cls, address: str, settings: CanSettings) -> None:
        needed_module("can", "python-can", "can")
        interface = settings.interface
        if interface != "socketcan":
            from can.interfaces import VALID_INTERFACES

            if interface not in VALID_INTERFACES:
                hint = did_you_mean(interface, VALID_INTERFACES)
                raise SourceError(
                    f"interface: python-can has no {interface[:40]!r}{hint}"
                )
            return
        channels = can_channels()
        if address not in channels:
            hint = did_you_mean(address, channels)
            raise NotHereError(f"there is no CAN interface {address}{hint}")

        # The lowest flag of linux/if.h is IFF_UP.
        with contextlib.suppress(OSError, ValueError):
            flags = int(Path(f"/sys/class/net/{address}/flags").read_text(), 16)
            if not flags & 1:
                raise NotHereError(
                    f"the CAN interface {address} is down: ip link set {address} up"
                )

    def open(self) -> None:
        can = needed_module("can", "python-can", "can")
        settings = self._settings
        ids = self._chunks.ids
        self.check(self.address, settings)
        self._assembler.reset()
        self._parser.reset()
        options = {"channel": self.address, "fd": settings.fd}
        if settings.bitrate is not None:
            options["bitrate"] = settings.bitrate
        # Dropped by kernel or driver before this process is woken: other devices share the bus.
        if len(ids) <= MAX_FILTERS:
            options["can_filters"] = [_filter_of(number) for number in ids]
        # What drivers of several vendors have been seen to raise.
        kinds = (OSError, ValueError, TypeError, ImportError, KeyError)
        try:
            self._bus = can.Bus(interface=settings.interface, **options)
        except (can.CanError, *kinds) as error:
            reason = " ".join(str(error).split())
            raise SourceError(f"cannot be opened: {reason}") from error

    def receive(self, wait_s: float) -> list[Arrived]:
        from can import CanError

        frames: list[Arrived] = []
        for k in range(MAX_MESSAGES):
            try:
                # Only the first one is waited for.
                message = self._bus.recv(0 if k else wait_s)
            except CanError as error:
                raise OSError(str(error)) from error
            if message is None:
                break
            if message.is_error_frame or message.is_remote_frame:
                self._n_errors += message.is_error_frame
                continue
            # An id of 11 bits may be that of an extended frame, too.
            if message.is_extended_id != (message.arbitration_id > HIGHEST_STANDARD_ID):
                continue

            frames += self._taken(message.arbitration_id, bytes(message.data))
            if frames:
                break
        return frames

    def _taken(self, arbitration_id: int, data: bytes) -> list[Arrived]:
        if arbitration_id not in self._chunks.ids:
            return []
        self.n_bytes += len(data)
        # A frame came when its last chunk did.
        now_ns = time.monotonic_ns()
        raw = self._assembler.add(arbitration_id, data)
        if raw is None:
            return []
        return [(now_ns, frame) for frame in self._parser.feed(raw)]

    def close(self) -> None:
        if self._bus is not None:
            # The driver of any vendor may raise anything.
            with contextlib.suppress(Exception):
                self._bus.shutdown()
            self._bus = None

    def lost(self) -> dict[str, int]:
        """Error frames that the controller has reported."""
        return {"port_errors": self._n_errors}

    def hint(self) -> str:
        return "; also ids, chunk, index, counter"


def _filter_of(arbitration_id: int) -> dict[str, Any]:
    """The filter of python-can that passes an arbitration id alone."""
    is_extended = arbitration_id > HIGHEST_STANDARD_ID
    return {
        "can_id": arbitration_id,
        "can_mask": HIGHEST_ID,
        "extended": is_extended,
    }


def can_channels() -> list[str]:
    """CAN interfaces of this host that Linux knows."""
    names = []
    for path in Path("/sys/class/net").glob("*/type"):
        with contextlib.suppress(OSError):
            if path.read_text().strip() == CAN_TYPE:
                names.append(path.parent.name)
    return sorted(names)
