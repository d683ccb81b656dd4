"""The index of a bag's chunks, as small as it will be in the file."""

from __future__ import annotations

import zlib
from collections.abc import Iterator

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import Writer

BLOCK_BYTES = 1 << 16
"""So much of the index is squeezed at a time: what grows for hours is never copied as a whole."""


class PackedChunkIndex:
    """Takes the place of a writer's list of `ChunkIndex` records.

    A recording of hours has some ten thousand chunks an hour: as objects they take 1 kB each, as
    records of the file 90 bytes, and squeezed a fifth of that. It is filled with `append`; what it
    gives, once, writes them all.
    """

    def __init__(self) -> None:
        self._records = RecordBuilder()
        self._blocks: list[bytes] = []

    def append(self, index: ChunkIndex) -> None:
        """Take in the index of a chunk that has been written."""
        index.write(self._records)
        if self._records.count >= BLOCK_BYTES:
            self._squeeze()

    def __iter__(self) -> Iterator[PackedChunkIndex]:
        yield self

    def write(self, stream: RecordBuilder) -> None:
        """Write all records, and forget them."""
        self._squeeze()
        for block in self._blocks:
            stream.write(zlib.decompress(block))
        self._blocks.clear()

    def _squeeze(self) -> None:
        records = self._records.end()  # type: ignore[no-untyped-call]
        self._blocks.append(zlib.compress(records, 1))


def pack_chunk_index(writer: Writer) -> None:
    """Let a writer that has written nothing yet keep its index packed.

    The list is the library's own; where another version has it elsewhere, nothing changes but
    the memory it takes.
    """
    vars(writer)["_Writer__chunk_indices"] = PackedChunkIndex()
