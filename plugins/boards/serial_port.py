"""A board on a serial port, opened by pyserial."""

import contextlib
import fcntl
import os
import re
import select
import stat
import struct
import time
from collections import Counter, deque
from itertools import pairwise
from pathlib import Path
from typing import Any

from sparseskin.nodes.errors import NotHereError, SourceError
from sparseskin.nodes.lookup import did_you_mean

from .framing import Counts, FrameParser, Framing
from .ports import MAX_READS, READ_BYTES, Arrived, Port, needed_module
from .settings import SerialSettings

TIOCGICOUNT = 0x545D
"""Linux: counters of a serial port. Source: asm-generic/ioctls.h; struct serial_icounter_struct."""
DEVICES = ("ttyUSB*", "ttyACM*", "ttyAMA*", "rfcomm*", "cu.usb*")
"""Names in /dev of serial ports that a board may be at: USB, the pins of small computers, radio."""


class SerialPort(Port):
    """A stream of bytes from a serial port."""

    def __init__(
        self, address: str, settings: SerialSettings, framing: Framing, counts: Counts
    ) -> None:
        super().__init__(address, settings, framing, counts)
        self.parser = FrameParser(framing, counts)
        self._port: Any = None
        # End of each read in the stream, and its time.
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=4096)
        self._overruns = 0
        self._recent: deque[bytes] = deque(maxlen=64)

    @classmethod
    def check(cls, address: str, settings: SerialSettings) -> None:
        needed_module("serial", "pyserial", "serial")
        try:
            state = os.stat(address)
        except (OSError, ValueError):
            hint = did_you_mean(address, serial_devices())
            raise NotHereError(f"there is no device {address}{hint}") from None
        if not stat.S_ISCHR(state.st_mode):
            raise SourceError("is no serial port")
        if not os.access(address, os.R_OK | os.W_OK):
            raise SourceError(
                "this user may not open it; on most systems members of the group dialout may"
            )

    def open(self) -> None:
        self.check(self.address, self._settings)
        serial = needed_module("serial", "pyserial", "serial")
        # Bytes from before belong to no frame any more.
        self.parser.reset()
        try:
            self._port = serial.Serial(
                self.address, self._settings.baud, timeout=0, exclusive=True
            )
        except (OSError, ValueError) as error:
            # SerialException is an OSError.
            reason = str(error)
            if isinstance(error, OSError) and error.errno is not None:
                reason = os.strerror(error.errno)
            if "lock" in str(error):
                reason = "another program has it open"
            raise SourceError(f"cannot be opened: {reason}") from error

    def receive(self, wait_s: float) -> list[Arrived]:
        fd = self._port.fileno()
        frames: list[Arrived] = []
        readable, _, _ = select.select([fd], [], [], wait_s)
        if not readable:
            return frames
        for k in range(MAX_READS):
            data = os.read(fd, READ_BYTES)
            if not data:
                # A device that was readable and has nothing was unplugged.
                if not k:
                    raise OSError("the device is gone")
                break

            now_ns = time.monotonic_ns()
            self.n_bytes += len(data)
            self._recent.append(data)
            # A frame came when the read with its last byte returned.
            self._arrivals.append((self.n_bytes, now_ns))
            for frame in self.parser.feed(data):
                frames.append((self._arrival_of(frame.end), frame))
        return frames

    def _arrival_of(self, end: int) -> int:
        # Frames end in the order in which their bytes came.
        while self._arrivals[0][0] < end:
            self._arrivals.popleft()
        return self._arrivals[0][1]

    def close(self) -> None:
        if self._port is not None:
            # The counters of the driver go with the device.
            self.lost()
            with contextlib.suppress(OSError):
                self._port.close()
            self._port = None

    def lost(self) -> dict[str, int]:
        """Errors that the driver of the port has counted: overruns, framing, parity."""
        if self._port is not None:
            with contextlib.suppress(OSError):
                raw = fcntl.ioctl(self._port.fileno(), TIOCGICOUNT, bytes(80))
                # After six other counters: frame, overrun, parity, breaks, buffer overrun.
                counters = struct.unpack_from("5i", raw, 24)
                n_breaks = counters[3]
                self._overruns = max(self._overruns, sum(counters) - n_breaks)
        return {"port_errors": self._overruns}

    def hint(self) -> str:
        framing = self.parser.framing
        recent = b"".join(self._recent)
        start = framing.prefix.hex(" ").upper()
        # Where the start bytes repeat, their distance is the length of a frame.
        matches = re.finditer(re.escape(framing.prefix), recent)
        places = [match.start() for match in matches]
        if len(places) < 2:
            if len(recent) < framing.n_bytes:
                return ""
            return f"; the start bytes {start} hardly occur"

        # The most frequent distance of two starts.
        distances = Counter(b - a for a, b in pairwise(places))
        ((distance, n_times),) = distances.most_common(1)
        if n_times < 2 or distance == framing.n_bytes:
            return ""
        n_payload = distance - framing.n_bytes + framing.payload_bytes
        return (
            f"; from {start} to {start} it is {distance} bytes, {n_payload} of readings"
        )


def serial_devices(dev: Path = Path("/dev")) -> dict[str, str]:
    """Serial ports of this host that a board may be at, sorted, by the device that each is now; a
    port of USB by its name in serial/by-id, which it keeps wherever it is plugged in.
    """
    links = dev.glob("serial/by-id/*")
    name_of_device = {os.path.realpath(link): str(link) for link in links}
    paths = sorted(str(path) for name in DEVICES for path in dev.glob(name))
    return {name_of_device.get(os.path.realpath(path), path): path for path in paths}
