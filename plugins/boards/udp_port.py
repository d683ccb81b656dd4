"""A board that sends UDP packets."""

import re
import select
import socket
import sys
import time
from functools import partial
from typing import Any

from sparseskin.nodes.errors import SourceError

from .framing import Counts, Framing, PacketParser
from .ports import MAX_READS, READ_BYTES, Arrived, Port
from .settings import UdpSettings

RECEIVE_BUFFER_BYTES = 1 << 22
"""Buffer of the socket that is asked for; the kernel may give less."""
HOLD_S = 2.0
"""Silence of the sender after which frames of another one are used, seconds; chosen: a board that
is started again may send from another port."""
PORT = re.compile("[1-9][0-9]{0,4}")
SO_RXQ_OVFL = 40
"""Linux: with a packet the kernel states how many it has dropped. Source: asm-generic/socket.h."""


class UdpPort(Port):
    """Packets of whole frames at a UDP port, of the first address and port that sends one; those of
    others are counted and dropped. Where the settings state a sender, all its ports are one.
    """

    def __init__(
        self, address: str, settings: UdpSettings, framing: Framing, counts: Counts
    ) -> None:
        super().__init__(address, settings, framing, counts)
        self._new_parser = partial(PacketParser, framing, counts)
        self._parser = self._new_parser()
        self._sender: tuple[str, int] | None = None
        self._heard_s = 0.0
        self._socket: socket.socket | None = None
        self._n_dropped = 0
        self._n_strangers = 0
        self._last_bytes = 0

    @classmethod
    def check(cls, address: str, settings: Any) -> None:
        if not (PORT.fullmatch(address) and int(address) <= 65535):
            raise SourceError(
                f"{address[:40]!r} is no port; a port is a number in 1..65535"
            )

    def open(self) -> None:
        self._parser.reset()
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            if sys.platform == "linux":
                opened.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
            opened.bind((self._settings.bind, int(self.address)))
            # Several packets may wait: they are read until there is none.
            opened.setblocking(False)
        except OSError as error:
            opened.close()
            raise SourceError(
                f"port {self.address} of {self._settings.bind} cannot be opened: "
                f"{error.strerror}"
            ) from error
        self._socket = opened

    def receive(self, wait_s: float) -> list[Arrived]:
        assert self._socket is not None
        frames: list[Arrived] = []
        readable, _, _ = select.select([self._socket], [], [], wait_s)
        if not readable:
            return frames
        for _ in range(MAX_READS):
            try:
                packet, ancillary, _, sender = self._socket.recvmsg(READ_BYTES, 64)
            except BlockingIOError:
                break
            now_ns = time.monotonic_ns()
            # The kernel states how many packets it has dropped so far.
            for level, kind, value in ancillary:
                if (level, kind) == (socket.SOL_SOCKET, SO_RXQ_OVFL):
                    n_dropped = int.from_bytes(value, sys.byteorder)
                    self._n_dropped = max(self._n_dropped, n_dropped)
            # Frames of two boards must never be mixed.
            if self._is_heard(sender, now_ns / 1e9):
                frames += self._taken(packet, sender, now_ns)
            else:
                self._drop_stranger(sender)
        return frames

    def _taken(
        self, packet: bytes, sender: tuple[str, int], now_ns: int
    ) -> list[Arrived]:
        """Frames of a packet; a sender whose first packet has some is the one from now on."""
        self.n_bytes += len(packet)
        self._last_bytes = len(packet)
        is_new = self._settings.sender is None and sender != self._sender
        # Its numbers have nothing to do with those of the sender before.
        parser = self._new_parser() if is_new else self._parser
        accepted = parser.feed(packet)
        if accepted:
            if is_new and self._sender is not None:
                self.lines.append(f"{_text(sender)} is the sender now")
            self._parser = parser
            self._sender = sender
            self._heard_s = now_ns / 1e9
        return [(now_ns, frame) for frame in accepted]

    def _drop_stranger(self, sender: tuple[str, int]) -> None:
        """Count a packet of another sender; the first one is logged."""
        self._n_strangers += 1
        if self._n_strangers == 1:
            heard = self._settings.sender or _text(self._sender)
            self.lines.append(
                f"packets of {_text(sender)} are dropped; {heard} is the sender"
            )

    def _is_heard(self, sender: tuple[str, int], now_s: float) -> bool:
        if self._settings.sender is not None:
            address, _ = sender
            return bool(address == self._settings.sender)
        # The first sender is held while it sends, so that no other one can take its place.
        return self._sender in (None, sender) or now_s - self._heard_s >= HOLD_S

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def lost(self) -> dict[str, int]:
        """Packets that the kernel had no room for, and those of other senders."""
        return {"kernel_packets": self._n_dropped, "other_senders": self._n_strangers}

    def hint(self) -> str:
        return f"; the last packet had {self._last_bytes} bytes"


def _text(sender: tuple[str, int] | None) -> str:
    if sender is None:
        return "nobody"
    address, port = sender
    return f"{address}:{port}"
