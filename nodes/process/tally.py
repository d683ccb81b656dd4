"""Numbers of messages that a node has published, in memory that outlives it when it is killed."""

import mmap
import os
import struct
from collections.abc import Sequence

_COUNT = struct.Struct("=Q")
"""A number in the file: 8 bytes, which a processor writes at once. A killed node leaves no half."""


class Tally:
    """One number a topic, in an unnamed file in memory, which the launcher makes and its node
    inherits by its descriptor `fd`. Raises OSError if it cannot be made.
    """

    def __init__(self, topics: Sequence[str], fd: int | None = None) -> None:
        self._topics = {topic: k for k, topic in enumerate(topics)}
        if fd is None:
            fd = os.memfd_create("tally")
        self.fd = fd
        size = _COUNT.size * len(topics)
        os.ftruncate(self.fd, size)
        # No byte can be mapped of an empty file.
        self._numbers: mmap.mmap | None = None
        if size:
            self._numbers = mmap.mmap(self.fd, size)

    def set(self, topic: str, n: int) -> None:
        """Set the number of messages published on a topic; of others than stated, none is kept."""
        # A node of a user's may publish more than it has declared.
        place = self._topics.get(topic)
        if place is not None and self._numbers is not None:
            _COUNT.pack_into(self._numbers, _COUNT.size * place, n)

    def close(self) -> dict[str, int]:
        """Close the file; return what it held, as `counts` does."""
        counts = self.counts()
        if self._numbers is not None:
            self._numbers.close()
        os.close(self.fd)
        return counts

    def counts(self) -> dict[str, int]:
        """Number of messages of each topic that has some."""
        size = _COUNT.size * len(self._topics)
        content = os.pread(self.fd, size, 0)
        numbers = _COUNT.iter_unpack(content)
        counts = {}
        for topic, (n,) in zip(self._topics, numbers, strict=True):
            if n:
                counts[topic] = n
        return counts
