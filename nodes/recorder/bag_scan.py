"""Goes through a bag that no index vouches for, up to its end or to the first break."""

from __future__ import annotations

from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, MessageIndex, Metadata, Schema

from .bag import BagError
from .bag_index import BagIndex
from .bag_records import (
    MAGIC,
    Break,
    Record,
    content,
    open_chunk,
    parse,
    size_of,
    walk,
    walk_chunk,
)


def scan(file: BinaryIO, name: str, damage: str) -> tuple[BagIndex, str]:
    """Find every complete message before the first break, each proven by a checksum.

    Parameters
    ----------
    file : binary file
        The bag.
    name : str
        Its name in errors.
    damage : str
        What is known to be wrong with it.

    Returns
    -------
    index : BagIndex
        What was found.
    recovered : str
        "" for a whole file; else how many messages were found, and where the break is.

    Raises
    ------
    BagError
        If the file is no bag that this program reads, or broken before anything was recorded.
    """
    scanner = _Scanner(file, name)
    index, size = scanner.index, size_of(file)
    try:
        scanner.run(size)
    except Break as broken:
        if not index.is_bag:
            raise BagError(
                f"{name}: cannot be read from byte {broken.offset} of {size} on ({broken.why}), "
                "before anything was recorded"
            ) from broken
        where = f"byte {broken.offset} of {size}: {broken.why}"
    else:
        if not index.is_bag:
            raise BagError(f"{name}: {index.of_another_program()}")
        damage = scanner.damage or damage
        if not damage:
            return index, ""
        where = f"the end: {damage}"
    some = "1 message" if index.n_scanned == 1 else f"{index.n_scanned} messages"
    return index, f"{some} recovered, up to {where}"


class _Scanner:
    def __init__(self, file: BinaryIO, name: str) -> None:
        self.index = BagIndex()
        self.damage = ""
        self._file = file
        self._name = name
        self._schemas: dict[int, Schema] = {}

    def run(self, size: int) -> None:
        """Go on to the end of the data, or raise Break."""
        for record in walk(self._file, len(MAGIC), size):
            if record.opcode == Opcode.DATA_END:
                return
            try:
                self._take(record)
            except Break:
                # These hold no force, and what follows them can be found.
                if record.opcode not in (Opcode.HEADER, Opcode.METADATA) or self.index.chunks:
                    raise
                self.damage = f"the record at byte {record.offset} is damaged"
        raise Break(size, "it ends there without an index; its recorder was killed or still runs")

    def _take(self, record: Record) -> None:
        data = content(self._file, record)
        if record.opcode == Opcode.CHUNK:
            self._take_chunk(record, open_chunk(data, record.offset))
        elif record.opcode == Opcode.METADATA:
            found = parse(Metadata.read, data, record.offset)
            self.index.metadata.setdefault(found.name, found.metadata)
        elif record.opcode == Opcode.HEADER and record.offset == len(MAGIC):
            self.index.library = parse(Header.read, data, record.offset).library
        elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._describe(record.opcode, data, record.offset)
        elif record.opcode == Opcode.MESSAGE_INDEX:
            parse(MessageIndex.read, data, record.offset)
        elif record.opcode == Opcode.ATTACHMENT:
            parse(Attachment.read, data, record.offset)
        elif record.opcode == Opcode.MESSAGE:
            raise Break(record.offset, "a message outside the chunks, which no checksum protects")
        else:
            raise Break(record.offset, "no record of a recording begins there")

    def _take_chunk(self, record: Record, plain: bytes) -> None:
        for opcode, start, stop in walk_chunk(plain, record.offset):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe(opcode, plain[start:stop], record.offset)
        self.index.add_chunk(record, plain)

    def _describe(self, opcode: int, data: bytes, offset: int) -> None:
        if opcode == Opcode.SCHEMA:
            schema = parse(Schema.read, data, offset)
            self._schemas[schema.id] = schema
        else:
            self.index.add_channel(self._name, parse(Channel.read, data, offset), self._schemas)
