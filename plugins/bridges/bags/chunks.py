"""Files of records, some of which are chunks of further records: the parts of .bag and .mcap that
are the same.
"""

from abc import abstractmethod
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from typing import IO, Any, ClassVar

from sparseskin.nodes.recorder.bag.records import Break
from sparseskin.nodes.sensor.layout.checks import reading

from .storage import Recorded, Storage

Record = Any
"""A record; its `offset` is the byte at which it begins, or the chunk that holds it."""


class ChunkedStorage(Storage):
    """A file of records. Its subclasses raise Break where it cannot be read."""

    MAGIC: ClassVar[bytes]
    #: Bytes from and up to which the index stands; None: there is none.
    index: tuple[int, int] | None = None

    @abstractmethod
    def records(self, file: IO[bytes], begin: int, stop: int) -> Iterator[Record]:
        """The records from a byte on, up to the end of the data."""

    @abstractmethod
    def in_chunk(self, record: Record) -> Iterable[Record]:
        """The records of a chunk; of a record that is none, itself."""

    @abstractmethod
    def in_begin_of_chunk(self, file: IO[bytes], stop: int) -> Iterable[Record]:
        """The records of a chunk that begins at the place of a file, and whose end is missing."""

    @abstractmethod
    def note(self, record: Record) -> None:
        """Note the connection that a record states, if it states one."""

    @abstractmethod
    def payload(self, record: Record) -> tuple[int, int, bytes] | None:
        """Number of the connection, time and bytes of a message; None of another record."""

    def read_index(self) -> None:
        if self.index is None:
            return
        with reading(self.path) as file:
            try:
                for record in self.records(file, *self.index):
                    self.note(record)
            # Without an index the connections are read beside the messages.
            except Break:
                self.connections.clear()

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        self.losses.clear()
        with reading(self.path) as file:
            size = file.seek(0, 2)
            try:
                for record in self.records(file, len(self.MAGIC), size):
                    yield from self._of_record(record, topics)
            except Break as fault:
                # What was read so far remains: the loss is named, and the rest is tried.
                place = fault.offset
                self.losses.append(f"behind byte {place} of {size} ({fault.why})")
                file.seek(place)
                # It may be a chunk whose end is missing, which is named by then.
                with suppress(Break):
                    yield from self._all(self.in_begin_of_chunk(file, size), topics)

    def _of_record(self, record: Record, topics: Collection[str]) -> Iterator[Recorded]:
        """The messages of a record; a damaged chunk costs itself."""
        try:
            yield from self._all(self.in_chunk(record), topics)
        except Break as fault:
            self.losses.append(f"in the record at byte {record.offset} ({fault.why})")

    def _all(
        self, records: Iterable[Record], topics: Collection[str]
    ) -> Iterator[Recorded]:
        """The messages of some records, none of which is a chunk."""
        for record in records:
            self.note(record)
            payload = self.payload(record)
            if payload is None:
                continue
            number, log_ns, data = payload
            if number not in self.connections:
                raise Break(record.offset, "a message there has no connection")
            topic, described = self.connections[number]
            if topic in topics:
                yield Recorded(topic, described.kind, log_ns, data)
