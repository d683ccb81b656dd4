"""A board that sends UDP packets."""

from __future__ import annotations

import select
import socket
import sys
import time
from typing import Any

from sparseskin.nodes.errors import SourceError

from .framing import Counts, Framing, PacketParser
from .ports import MAX_READS, READ_BYTES, Arrived, Port
from .settings import UdpSettings

RECEIVE_BUFFER_BYTES = 1 << 22
"""Buffer of the socket that is asked for; the kernel may give less."""
SO_RXQ_OVFL = 40
"""Linux: with a packet the kernel states how many it has dropped. Source: asm-generic/socket.h."""


class UdpPort(Port):
    """Packets of whole frames at a UDP port."""

    def __init__(
        self, address: str, settings: UdpSettings, framing: Framing, counts: Counts
    ) -> None:
        super().__init__(address, settings, framing, counts)
        self._parser = PacketParser(framing, counts)
        self._socket: socket.socket | None = None
        self._n_dropped = self._n_strangers = self._last_bytes = 0

    @classmethod
    def check(cls, address: str, settings: Any) -> None:
        if not (address.isascii() and address.isdigit() and 0 < int(address[:6]) < 65536):
            raise SourceError(f"{address[:40]!r} is no port; a port is a number in 1..65535")

    def open(self) -> None:
        self._parser.reset()
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            if sys.platform == "linux":
                opened.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
            opened.bind((self._settings.bind, int(self.address)))
            opened.setblocking(False)
        except OSError as error:
            opened.close()
            place = f"port {self.address} of {self._settings.bind}"
            raise SourceError(f"{place} cannot be opened: {error.strerror}") from error
        self._socket = opened

    def receive(self, wait_s: float) -> list[Arrived]:
        assert self._socket is not None
        frames: list[Arrived] = []
        if not select.select([self._socket], [], [], wait_s)[0]:
            return frames
        for _ in range(MAX_READS):
            try:
                packet, notes, _, sender = self._socket.recvmsg(READ_BYTES, 64)
            except BlockingIOError:
                break
            now_ns = time.monotonic_ns()
            for level, kind, value in notes:
                if (level, kind) == (socket.SOL_SOCKET, SO_RXQ_OVFL):
                    self._n_dropped = max(self._n_dropped, int.from_bytes(value, sys.byteorder))
            if self._settings.sender not in (None, sender[0]):
                self._n_strangers += 1
                continue
            self.n_bytes += len(packet)
            self._last_bytes = len(packet)
            frames += [(now_ns, frame) for frame in self._parser.feed(packet)]
        return frames

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def lost(self) -> dict[str, int]:
        """Packets that the kernel had no room for, and those of other senders."""
        return {"kernel_packets": self._n_dropped, "other_senders": self._n_strangers}

    def hint(self) -> str:
        return f"; the last packet had {self._last_bytes} bytes"
