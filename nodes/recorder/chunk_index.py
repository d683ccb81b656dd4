"""The index of a bag's chunks, as small as it will be in the file."""

from __future__ import annotations

from collections.abc import Iterator

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import Writer


class PackedChunkIndex:
    """Takes the place of a writer's list of `ChunkIndex` records.

    A recording of hours has some ten thousand chunks an hour: as records of the file they take 90
    bytes each, as objects 1 kB. It is filled with `append`; what it gives, once, writes them all.
    """

    def __init__(self) -> None:
        self._records = RecordBuilder()

    def append(self, index: ChunkIndex) -> None:
        """Take in the index of a chunk that has been written."""
        index.write(self._records)

    def __iter__(self) -> Iterator[PackedChunkIndex]:
        yield self

    def write(self, stream: RecordBuilder) -> None:
        """Write all records, and forget them."""
        stream.write(self._records.end())  # type: ignore[no-untyped-call]


def pack_chunk_index(writer: Writer) -> None:
    """Let a writer that has written nothing yet keep its index packed.

    The list is the library's own; where another version has it elsewhere, nothing changes but
    the memory it takes.
    """
    vars(writer)["_Writer__chunk_indices"] = PackedChunkIndex()
