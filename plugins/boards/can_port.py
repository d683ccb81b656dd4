"""A board on a CAN bus, opened by python-can."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

from sparseskin.nodes.errors import NotHereError, SourceError
from sparseskin.nodes.lookup import did_you_mean

from .can_chunks import HIGHEST_STANDARD_ID, Assembler, chunks_of
from .framing import Counts, Framing, PacketParser
from .ports import Arrived, Port, needed_module
from .settings import CanSettings

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
        if settings.interface != "socketcan":
            from can.interfaces import VALID_INTERFACES

            if settings.interface not in VALID_INTERFACES:
                raise SourceError(
                    f"interface: python-can has no {settings.interface[:40]!r}"
                    f"{did_you_mean(settings.interface, VALID_INTERFACES)}"
                )
            return
        channels = can_channels()
        if address not in channels:
            hint = did_you_mean(address, channels)
            raise NotHereError(f"there is no CAN interface {address}{hint}")
        with contextlib.suppress(OSError, ValueError):
            if not int(Path(f"/sys/class/net/{address}/flags").read_text(), 16) & 1:
                raise NotHereError(f"the CAN interface {address} is down: ip link set {address} up")

    def open(self) -> None:
        can = needed_module("can", "python-can", "can")
        settings, ids = self._settings, self._chunks.ids
        self.check(self.address, settings)
        self._assembler.reset()
        self._parser.reset()
        options: dict[str, Any] = {} if settings.bitrate is None else {"bitrate": settings.bitrate}
        if len(ids) <= MAX_FILTERS:
            options["can_filters"] = [
                {"can_id": one, "can_mask": 0x1FFFFFFF, "extended": one > HIGHEST_STANDARD_ID}
                for one in ids
            ]
        try:
            self._bus = can.Bus(
                channel=self.address, interface=settings.interface, fd=settings.fd, **options
            )
        except (can.CanError, OSError, ValueError, TypeError, ImportError, KeyError) as error:
            reason = " ".join(str(error).split())
            raise SourceError(f"cannot be opened: {reason}") from error

    def receive(self, wait_s: float) -> list[Arrived]:
        from can import CanError

        frames: list[Arrived] = []
        for k in range(MAX_MESSAGES):
            try:
                message = self._bus.recv(0 if k else wait_s)
            except CanError as error:
                raise OSError(str(error)) from error
            if message is None:
                break
            if message.is_error_frame or message.is_remote_frame:
                self._n_errors += message.is_error_frame
                continue
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
        now_ns = time.monotonic_ns()
        whole = self._assembler.add(arbitration_id, data)
        return [] if whole is None else [(now_ns, frame) for frame in self._parser.feed(whole)]

    def close(self) -> None:
        if self._bus is not None:
            with contextlib.suppress(Exception):  # a driver of any vendor
                self._bus.shutdown()
            self._bus = None

    def lost(self) -> dict[str, int]:
        """Error frames that the controller has reported."""
        return {"port_errors": self._n_errors}

    def hint(self) -> str:
        return "; also ids, chunk, index, counter"


def can_channels() -> list[str]:
    """CAN interfaces of this host that Linux knows."""
    found = []
    for path in Path("/sys/class/net").glob("*/type"):
        with contextlib.suppress(OSError):
            if path.read_text().strip() == CAN_TYPE:
                found.append(path.parent.name)
    return sorted(found)
