"""Numbers of messages that a node has published, in memory that outlives it when it is killed."""

import os
import struct
from collections.abc import Sequence

_COUNT = struct.Struct("=Q")


class Tally:
    """One number a topic, in an unnamed file in memory, which the launcher makes and its node
    inherits by its descriptor `fd`. Raises OSError if it cannot be made.
    """

    def __init__(self, topics: Sequence[str], fd: int | None = None) -> None:
        self._topics = {topic: k for k, topic in enumerate(topics)}
        self.fd = os.memfd_create("tally") if fd is None else fd
        os.ftruncate(self.fd, _COUNT.size * len(topics))

    def set(self, topic: str, n: int) -> None:
        """Set the number of messages published on a topic; of others than stated, none is kept."""
        if topic in self._topics:
            os.pwrite(self.fd, _COUNT.pack(n), _COUNT.size * self._topics[topic])

    def close(self) -> dict[str, int]:
        """Close the file; return what it held, as `counts` does."""
        found = self.counts()
        os.close(self.fd)
        return found

    def counts(self) -> dict[str, int]:
        """Number of messages of each topic that has some."""
        held = _COUNT.iter_unpack(os.pread(self.fd, _COUNT.size * len(self._topics), 0))
        return {topic: n for topic, (n,) in zip(self._topics, held, strict=True) if n}
