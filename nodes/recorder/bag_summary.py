"""The index at the end of a whole bag: read instead of the bag, if checksums prove both."""

from __future__ import annotations

import dataclasses
import json
from typing import Any, BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Header, Metadata, Schema

from .bag import JSON_KEY, LIBRARY_PREFIX, TOPICS_RECORD, Tally
from .bag_index import BagIndex, ChunkSpan
from .bag_records import HEAD_BYTES, MAGIC, Break, Record, content, crc_of, parse, size_of, walk

_FOOTER_BYTES = HEAD_BYTES + 20
_DATA_END_BYTES = HEAD_BYTES + 4
_SUMMARY_CRC_BYTES = 4
NO_INDEX = "the index at its end is missing or damaged"


def read_index(file: BinaryIO, name: str) -> tuple[BagIndex | None, str]:
    """Read the index at the end of a file, if checksums prove the file whole.

    Returns
    -------
    index : BagIndex or None
        None: the file must be scanned.
    damage : str
        What the checksums say is wrong; "" where they say nothing.

    Raises
    ------
    BagError
        If the file is whole, but no bag that this program reads.
    """
    size = size_of(file)
    tail_at = size - _FOOTER_BYTES - len(MAGIC)
    file.seek(max(tail_at, 0))
    tail = file.read(_FOOTER_BYTES + len(MAGIC))
    if tail_at < len(MAGIC) or not tail.endswith(MAGIC) or tail[0] != Opcode.FOOTER:
        return None, NO_INDEX
    footer = parse(Footer.read, tail[HEAD_BYTES:_FOOTER_BYTES], tail_at)
    data_end_at = footer.summary_start - _DATA_END_BYTES
    if not len(MAGIC) <= data_end_at <= tail_at - _DATA_END_BYTES:
        return None, "" if footer.summary_start == 0 else NO_INDEX
    # The checksum covers the footer as well, up to the checksum itself.
    summary_crc = crc_of(file, footer.summary_start, size - len(MAGIC) - _SUMMARY_CRC_BYTES)
    if footer.summary_crc and summary_crc != footer.summary_crc:
        return None, NO_INDEX
    try:
        data_end = next(walk(file, data_end_at, size))
        if data_end.opcode != Opcode.DATA_END or data_end.stop != footer.summary_start:
            raise Break(data_end_at, "no end of data")
        stated = parse(DataEnd.read, content(file, data_end), data_end_at).data_section_crc
    except Break:
        return None, NO_INDEX
    if stated and crc_of(file, 0, data_end_at) != stated:
        return None, "a record outside the messages is damaged"
    if not (stated and footer.summary_crc):
        return None, ""
    try:
        return _from_summary(file, name, footer.summary_start, tail_at), ""
    # Checksums that match and content that does not: another program has changed the file.
    except (Break, KeyError, TypeError, ValueError, RecursionError):
        return None, ""


def _from_summary(file: BinaryIO, name: str, start: int, stop: int) -> BagIndex | None:
    index = BagIndex()
    index.library = _library(file, stop)
    if not index.library.startswith(LIBRARY_PREFIX):
        return None
    schemas: dict[int, Schema] = {}
    channels: list[Channel] = []
    chunks: list[ChunkIndex] = []
    for record in walk(file, start, stop):
        data = content(file, record)
        if record.opcode == Opcode.SCHEMA:
            schema = parse(Schema.read, data, record.offset)
            schemas[schema.id] = schema
        elif record.opcode == Opcode.CHANNEL:
            channels.append(parse(Channel.read, data, record.offset))
        elif record.opcode == Opcode.CHUNK_INDEX:
            chunks.append(parse(ChunkIndex.read, data, record.offset))
        elif record.opcode == Opcode.METADATA_INDEX:
            _add_metadata(index, file, int.from_bytes(data[:8], "little"), start)
    for channel in channels:
        index.add_channel(name, channel, schemas)
    for chunk in chunks:
        offset, end = chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length
        index.chunks.append(
            ChunkSpan(
                Record(Opcode.CHUNK, offset, offset + HEAD_BYTES, end),
                frozenset(index.channels[id].topic for id in chunk.message_index_offsets),
                chunk.message_start_time,
                chunk.message_end_time,
            )
        )
    tallies = json.loads(index.metadata[TOPICS_RECORD][JSON_KEY])
    index.tallies = {topic: _tally(values) for topic, values in tallies.items()}
    if index.tallies.keys() != {channel.topic for channel in index.channels.values()}:
        return None
    return index


def _tally(values: dict[str, Any]) -> Tally:
    for key, value in values.items():
        if type(value) is not (str if key == "schema" else int):
            raise TypeError(key)
    tally = Tally(**values)
    if dataclasses.asdict(tally).keys() != values.keys():
        raise ValueError("incomplete")
    return tally


def _add_metadata(index: BagIndex, file: BinaryIO, offset: int, stop: int) -> None:
    record = next(walk(file, offset, stop))
    if record.opcode != Opcode.METADATA:
        raise Break(offset, "no metadata there")
    found = parse(Metadata.read, content(file, record), offset)
    index.metadata.setdefault(found.name, found.metadata)


def _library(file: BinaryIO, stop: int) -> str:
    record = next(walk(file, len(MAGIC), stop))
    if record.opcode != Opcode.HEADER:
        raise Break(record.offset, "the file does not begin with a header")
    header: Header = parse(Header.read, content(file, record), record.offset)
    return header.library
