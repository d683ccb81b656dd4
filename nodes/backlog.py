"""What has come for a node and waits, so that one that is behind can go on with the newest."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from sparseskin.messages.wire import is_end

from .sockets import QUEUE_FRAMES, Reader


class Waiting(NamedTuple):
    """A message as it came, and whether so many newer ones wait that it is to be skipped."""

    topic: bytes
    payload: bytes
    overtaken: bool


class Backlog:
    """Takes messages from a reader, first come first; of a stream only the newest count.

    An ask stands for a writer that waits for what it has sent: nothing before it is overtaken. The
    end of a stream overtakes nothing: its last messages are taken in.

    Parameters
    ----------
    reader : Reader
    streams : collection of bytes
        Topics of which messages can be overtaken.
    """

    def __init__(self, reader: Reader, streams: frozenset[bytes]) -> None:
        self._reader = reader
        self._streams = streams
        self._queue: deque[tuple[bytes, bytes]] = deque()

    def take(self, depth: int) -> Waiting | None:
        """The next message, or None where none waits.

        Parameters
        ----------
        depth : int
            How many messages of a stream may wait; it is overtaken where that many newer ones
            do. 0: any number.
        """
        while depth and len(self._queue) < QUEUE_FRAMES:
            parts = self._reader.receive()
            if parts is None:
                break
            self._queue.append(parts)
        first = self._queue.popleft() if self._queue else self._reader.receive()
        if first is None:
            return None
        topic, payload = first
        return Waiting(topic, payload, bool(depth) and self._is_overtaken(topic, depth))

    def _is_overtaken(self, topic: bytes, depth: int) -> bool:
        if topic not in self._streams:
            return False
        newer = 0
        for waiting, payload in self._queue:
            if self._reader.is_ask(waiting):
                return False
            newer += waiting == topic and not is_end(payload)
            if newer == depth:
                return True
        return False
