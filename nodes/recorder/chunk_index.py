"""The index of a bag's chunks, on the disk until the bag is complete."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import Writer

BLOCK_BYTES = 1 << 16
"""So much of the index is in memory at most."""


class StoredChunkIndex:
    """Takes the place of a writer's list of `ChunkIndex` records.

    A recording has some ten chunks a second: an hour of them takes 36 MB as objects, and 3 MB as
    records of the file. They are laid down in a file without a name, which ends with its process.
    It is filled with `append`; what it gives, once, writes them all.

    Parameters
    ----------
    folder : Path
        Where there is room for the bag, and so for its index.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._records = RecordBuilder()
        self._file: IO[bytes] | None = None
        self._n_stored = 0

    def append(self, index: ChunkIndex) -> None:
        """Take in the index of a chunk that has been written."""
        index.write(self._records)
        if self._records.count >= BLOCK_BYTES:
            self._store()

    def __iter__(self) -> Iterator[StoredChunkIndex]:
        yield self

    def write(self, stream: RecordBuilder) -> None:
        """Write all records, and forget them."""
        if self._file is not None:
            self._file.seek(0)
            while block := self._file.read(min(BLOCK_BYTES, self._n_stored - self._file.tell())):
                stream.write(block)
            self._file.close()
            self._file = None
        stream.write(self._records.end())  # type: ignore[no-untyped-call]

    def _store(self) -> None:
        """Lay down what is in memory; where the disk refuses, it stays there until the next."""
        records: bytes = self._records.end()  # type: ignore[no-untyped-call]
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115
            done = 0
            while done < len(records):
                where = self._n_stored + done
                done += os.pwrite(self._file.fileno(), memoryview(records)[done:], where)
        except OSError:
            self._records.write(records)
        else:
            self._n_stored += len(records)


def store_chunk_index(writer: Writer, folder: Path) -> None:
    """Let a writer that has written nothing yet keep its index on the disk.

    The list is the library's own; where another version has it elsewhere, nothing changes but
    the memory it takes.
    """
    vars(writer)["_Writer__chunk_indices"] = StoredChunkIndex(folder)
