"""Messages that wait for a node, so that a slow one can continue with the newest."""

from collections import deque

from sparseskin.messages.wire import Payload, is_end
from sparseskin.nodes.network.sockets import QUEUE_FRAMES, Reader

Waiting = tuple[bytes, Payload, bool]
"""Topic and payload of a message, and True if it is to be skipped because newer ones wait."""


class Backlog:
    """Reads messages from a reader in order, and marks those of a stream that are overtaken.

    No message before an ask is overtaken, since its writer waits until all are processed. The end
    of a stream overtakes none of its messages. `streams` are the topics that can be overtaken.
    """

    def __init__(self, reader: Reader, streams: frozenset[bytes]) -> None:
        self._reader = reader
        self._streams = streams
        self._queue: deque[tuple[bytes, Payload]] = deque()

    def take(self, depth: int) -> Waiting | None:
        """Next message, or None; `depth` newer ones of its stream overtake it, 0: none does."""
        if depth:
            self._fill()
        first = self._queue.popleft() if self._queue else self._reader.receive()
        if first is None:
            return None
        return *first, bool(depth) and self._is_overtaken(first[0], depth)

    def _fill(self) -> None:
        while len(self._queue) < QUEUE_FRAMES:
            parts = self._reader.receive()
            if parts is None:
                break
            self._queue.append(parts)

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
