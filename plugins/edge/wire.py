"""The wire from an edge: a serial line or UDP, opened and watched as those of other boards."""

from __future__ import annotations

import numpy as np

from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import did_you_mean, suggestion
from sparseskin.plugins.boards.board import Board, naming_board
from sparseskin.plugins.boards.settings import read_settings, split_source
from sparseskin.plugins.boards.source import BoardSource
from sparseskin.plugins.boards.udp_port import UdpPort

from .description import EdgeDescription
from .frames import framing_of

KEYS = {"serial": ("baud",), "udp": ("bind", "sender")}
"""Kinds of wires, and what may be stated of each."""


def describe_wire(source: str, description: EdgeDescription, skin: Skin) -> Board:
    """Describe the wire "serial:DEVICE[?baud=NUMBER]" or "udp:PORT[?bind=ADDRESS]", without opening
    it; `skin`: the one whose forces are measured. Raises SourceError if the source has another
    form, or a key or value is not allowed.
    """
    kind, address, query = split_source(source)
    if kind not in KEYS or not address:
        hint = suggestion(kind, KEYS) if kind not in KEYS else ""
        raise SourceError(f'"{source}": expected serial:DEVICE or udp:PORT{hint}')
    name = f"{kind}:{address}"
    with naming_board(name):
        for key in query:
            if key not in KEYS[kind]:
                raise SourceError(f"{key}: unknown key{did_you_mean(key, KEYS[kind])}")
        settings = read_settings(kind, query)
        settings.check_port()
        if kind == "udp":
            UdpPort.check(address, settings)
    framing = framing_of(description)
    # A payload is taken whole: nothing is decoded.
    return Board(name, kind, address, settings, lambda _: np.empty(0, np.float32), framing, skin)


class EdgeWire(BoardSource):
    """Payloads from a wire; the device, lost and damaged frames are treated as of other boards."""

    def next_payload(self, wait_s: float) -> tuple[int, bytes] | None:
        """Time at which the last byte of the next payload came on the monotonic clock, nanoseconds,
        and the payload; None if none came in `wait_s` seconds.
        """
        if not self._waiting:
            self.receive(wait_s)
        if not self._waiting:
            return None
        arrived_ns, frame = self._waiting.popleft()
        return arrived_ns, frame.payload
