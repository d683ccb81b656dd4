"""Index of a bag: its channels, chunks, counts and metadata.

It is read from the end of a complete bag if checksums prove the file whole. Any other file is
scanned up to its end or to the first break.
"""

import dataclasses
import io
import json
from dataclasses import dataclass, field
from typing import Any, BinaryIO, NamedTuple

import mcap.records as mcap
from mcap.opcode import Opcode

from sparseskin.messages import MessageError
from sparseskin.messages.ranges import INT64_MAX, is_whole
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.errors import counted

from . import format as form
from . import records as of_file
from .format import BagError, TopicInfo
from .records import HEAD_BYTES, MAGIC, Break, Record, record_at, records

_MAX_CHANNELS = 4096
"""Most channels of a file: a damaged or hostile one could list any number."""
_FOOTER_BYTES = HEAD_BYTES + 20
_DATA_END_BYTES = HEAD_BYTES + 4
_SUMMARY_CRC_BYTES = 4
SOURCE_HINT = "; sparseskin recording import makes one of a file that a sensor reads"
_NO_INDEX = "the index at its end is missing or damaged"


class BagChannel(NamedTuple):
    """Topic and schema of the messages of a channel."""

    topic: str
    schema: str


class ChunkSpan(NamedTuple):
    """Position of a chunk, its topics, and the range of its log times."""

    offset: int
    stop: int
    topics: frozenset[str]
    first_log_ns: int
    last_log_ns: int


@dataclass
class BagIndex:
    """Content of a bag apart from its messages; `name` stands for the file in errors."""

    name: str
    library: str = ""
    channels: dict[int, BagChannel] = field(default_factory=dict)
    chunks: list[ChunkSpan] = field(default_factory=list)
    topics: dict[str, TopicInfo] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    n_scanned: int = 0
    _schemas: dict[int, mcap.Schema] = field(default_factory=dict)

    @property
    def is_bag(self) -> bool:
        """True if a channel or the metadata show that this program wrote the file."""
        return bool(self.channels) or form.GRAPH_RECORD in self.metadata

    @property
    def of_another_program(self) -> str:
        """Error text for an MCAP file that is no bag."""
        library = " ".join(self.library[:80].split())
        return f"an MCAP file of another program (library {library!r})"

    def describe(self, record: Record) -> None:
        """Add a schema, a channel or metadata.

        Raises Break if it is malformed, BagError for a channel of another program or version.
        """
        if record.opcode == Opcode.SCHEMA:
            schema = record.parsed(mcap.Schema.read)
            self._schemas[schema.id] = schema
        elif record.opcode == Opcode.CHANNEL:
            channel = record.parsed(mcap.Channel.read)
            if len(self.channels) >= _MAX_CHANNELS and channel.id not in self.channels:
                raise BagError(f"{self.name}: more than {_MAX_CHANNELS} channels")
            self.channels[channel.id] = self._checked(channel)
        elif record.opcode == Opcode.METADATA:
            metadata = record.parsed(mcap.Metadata.read)
            self.metadata.setdefault(metadata.name, metadata.metadata)

    def _checked(self, channel: mcap.Channel) -> BagChannel:
        schema = self._schemas.get(channel.schema_id)
        schema_name = "" if schema is None else schema.name
        kind = schema_name.removeprefix(form.SCHEMA_PREFIX)
        if channel.message_encoding != form.ENCODING or kind == schema_name:
            raise self._foreign(channel, schema_name)
        try:
            split_topic(channel.topic)
        except MessageError as error:
            raise BagError(f"{self.name}: {error}") from error

        place = f"{self.name}: topic {channel.topic[:80]}"
        if kind not in SCHEMAS:
            raise BagError(
                f"{place} holds messages of schema {kind[:40]!r}; this program reads "
                f"{', '.join(SCHEMAS)}"
            )
        version = channel.metadata.get(form.VERSION_KEY, "")
        if version != str(SCHEMAS[kind].version):
            raise BagError(
                f"{place}: recorded with {kind} version {version[:20] or 'unknown'}; "
                f"this program reads {SCHEMAS[kind].version}"
            )
        return BagChannel(channel.topic, kind)

    def _foreign(self, channel: mcap.Channel, schema_name: str) -> BagError:
        """The error of a channel of another program, with what opens its file."""
        encoding = channel.message_encoding
        hint = ""
        if encoding == "cdr":
            hint = form.ROS2_HINT
        elif self.library.startswith("foxglove") or schema_name.startswith("foxglove."):
            hint = "; it is for viewers: Foxglove and Lichtblick open it"

        whose = self.name
        has_our_library = self.library.startswith(form.LIBRARY_PREFIX)
        if not has_our_library and form.GRAPH_RECORD not in self.metadata:
            whose = f"{self.name}: {self.of_another_program}"
        return BagError(
            f"{whose}: topic {channel.topic[:80]!r} holds {encoding[:40]!r} messages "
            f"of schema {schema_name[:80]!r}; expected {form.ENCODING!r} and "
            f"{form.SCHEMA_PREFIX}...{hint}"
        )

    def add_chunk(self, record: Record) -> None:
        """Add the channels and count the messages of a chunk.

        Raises as `describe`, and Break if a message has no channel; then it counts none.
        """
        messages: list[tuple[BagChannel, int, int]] = []
        chunk = of_file.open_chunk(record)
        for opcode, content in of_file.chunk_records(chunk, record.offset):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.describe(Record(opcode, record.offset, bytes(content)))
            elif opcode == Opcode.MESSAGE:
                id, log_ns, stamp_ns, _ = of_file.message_of(content, record.offset)
                channel = self.channels.get(id)
                if channel is None or max(log_ns, stamp_ns) > INT64_MAX:
                    raise Break(
                        record.offset, "a message there has no channel or a wrong time"
                    )
                messages.append((channel, stamp_ns, log_ns))

        # Only a chunk without a fault is counted.
        for channel, stamp_ns, log_ns in messages:
            empty = TopicInfo(channel.schema, SCHEMAS[channel.schema].version)
            info = self.topics.setdefault(channel.topic, empty)
            info.add(channel.schema, stamp_ns, log_ns)
        self.n_scanned += len(messages)
        if messages:
            log_times = [log_ns for _, _, log_ns in messages]
            self.chunks.append(
                ChunkSpan(
                    offset=record.offset,
                    stop=record.stop,
                    topics=frozenset(channel.topic for channel, _, _ in messages),
                    first_log_ns=min(log_times),
                    last_log_ns=max(log_times),
                )
            )

    def list_chunk(self, record: Record) -> None:
        """Add a chunk of which the index at the end states position, topics and times. Raises Break
        if it is listed twice.
        """
        chunk = record.parsed(mcap.ChunkIndex.read)
        start = chunk.chunk_start_offset
        if self.chunks and start < self.chunks[-1].stop:
            raise Break(record.offset, "a chunk is listed twice")
        topics = frozenset(
            self.channels[id].topic for id in chunk.message_index_offsets
        )
        self.chunks.append(
            ChunkSpan(
                offset=start,
                stop=start + chunk.chunk_length,
                topics=topics,
                first_log_ns=chunk.message_start_time,
                last_log_ns=chunk.message_end_time,
            )
        )

    def chunks_with(
        self, topics: frozenset[str], start_ns: int | None, stop_ns: int | None
    ) -> list[ChunkSpan]:
        """The chunks that may hold a stamp in [start_ns, stop_ns) on one of the topics."""

        def may_hold(chunk: ChunkSpan, topic: str) -> bool:
            # Chunks are known by log times: a stamp lies a lag before its own.
            info = self.topics[topic]
            if start_ns is not None and chunk.last_log_ns - info.min_lag_ns < start_ns:
                return False
            return stop_ns is None or chunk.first_log_ns - info.max_lag_ns < stop_ns

        chunks = []
        for chunk in self.chunks:
            if any(may_hold(chunk, topic) for topic in chunk.topics & topics):
                chunks.append(chunk)
        return chunks


def load_index(file: BinaryIO, name: str, whole: bool = True) -> tuple[BagIndex, str]:
    """Read the index of a bag, or scan the file; `whole` as in `BagReader`.

    Also returns "" for a whole file; of a broken one, whose index has every complete message before
    the first break, the number of messages found and the place of the break. Raises BagError if the
    file is no bag that this program reads, or broken before the first record.
    """
    # A file may have been cut off within its first bytes: it is then none of another kind.
    begin = file.read(len(MAGIC))
    if not begin:
        raise BagError(f"{name}: is empty")
    if not MAGIC.startswith(begin):
        raise BagError(
            f"{name}: not an MCAP file (it begins with {begin!r}){SOURCE_HINT}"
        )
    if begin != MAGIC:
        raise BagError(
            f"{name}: ends after {len(begin)} bytes, before anything was recorded"
        )

    try:
        index, damage = _read_summary(file, name, whole)
    except Break:
        index = None
        damage = _NO_INDEX
    if index is None:
        return _scan(file, name, damage)
    return index, ""


def _read_summary(
    file: BinaryIO, name: str, whole: bool
) -> tuple[BagIndex | None, str]:
    """The index at the end, None if it must be scanned; its damage. Raises Break without one."""
    # From the end: the footer states where the summary begins, which follows the data.
    size = file.seek(0, io.SEEK_END)
    footer_at = max(size - _FOOTER_BYTES - len(MAGIC), 0)
    footer = record_at(file, footer_at, size, Opcode.FOOTER).parsed(mcap.Footer.read)
    if file.read() != MAGIC:
        raise Break(size, "the file does not end as MCAP does")
    if not footer.summary_start:
        return None, ""

    data_end_at = footer.summary_start - _DATA_END_BYTES
    data_end = record_at(file, data_end_at, footer_at, Opcode.DATA_END)
    data_crc = data_end.parsed(mcap.DataEnd.read).data_section_crc
    # The checksum covers the footer as well, up to the checksum itself.
    summary_stop = size - len(MAGIC) - _SUMMARY_CRC_BYTES
    summary_crc = of_file.crc_of(file, footer.summary_start, summary_stop)
    if footer.summary_crc and summary_crc != footer.summary_crc:
        return None, _NO_INDEX
    if data_crc and whole and of_file.crc_of(file, 0, data_end_at) != data_crc:
        return None, "a record outside the messages is damaged"
    # 0: not computed. Without a checksum the index is not believed.
    if not (data_crc and footer.summary_crc):
        return None, ""
    try:
        return _from_summary(file, name, footer.summary_start, footer_at), ""
    except BagError:
        raise
    # Checksums that match and content that does not, in any way: another program has changed it.
    except Exception:
        return None, ""


def _from_summary(file: BinaryIO, name: str, start: int, stop: int) -> BagIndex | None:
    """The index at start..stop of the file; None of another program."""
    # Counts by topic are of this program alone: the file of another one is scanned.
    index = BagIndex(name)
    header = record_at(file, len(MAGIC), stop, Opcode.HEADER)
    index.library = header.parsed(mcap.Header.read).library
    if not index.library.startswith(form.LIBRARY_PREFIX):
        return None
    for record in records(file, start, stop):
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            index.describe(record)
        elif record.opcode == Opcode.CHUNK_INDEX:
            index.list_chunk(record)
        elif record.opcode == Opcode.METADATA_INDEX:
            offset = int.from_bytes(record.data[:8], "little")
            index.describe(record_at(file, offset, start, Opcode.METADATA))
    # Counts by topic, which no record of MCAP has.
    topics = json.loads(index.metadata[form.TOPICS_RECORD][form.JSON_KEY])
    index.topics = {topic: _topic_info(values) for topic, values in topics.items()}

    # Counts of other topics than those of the channels are of no use.
    channels = set(index.channels.values())
    counted = {BagChannel(topic, info.schema) for topic, info in index.topics.items()}
    channel_topics = {channel.topic for channel in channels}
    if index.topics.keys() != channel_topics or not counted <= channels:
        return None
    return index


def _topic_info(values: dict[str, Any]) -> TopicInfo:
    """Counts of a topic; an error of any kind unless the values are those of one."""
    info = TopicInfo(**values)
    if dataclasses.asdict(info).keys() != values.keys() or info.first_ns > info.last_ns:
        raise ValueError("incomplete")
    for key, value in values.items():
        if key == "schema":
            is_valid = type(value) is str
        else:
            # Only the lag between two clocks can be below 0.
            low = -INT64_MAX if key.endswith("lag_ns") else 0
            is_valid = is_whole(value, low, INT64_MAX)
        if not is_valid:
            raise TypeError(key)
    return info


def _scan(file: BinaryIO, name: str, damage: str) -> tuple[BagIndex, str]:
    """Find every complete message before the first break, each proven by a checksum."""
    index = BagIndex(name)
    size = file.seek(0, io.SEEK_END)
    try:
        damage = _scan_records(file, index, size) or damage
        if not index.is_bag:
            raise BagError(f"{name}: {index.of_another_program}")
        if not damage:
            return index, ""
        where = f"the end: {damage}"
    except Break as broken:
        place = f"byte {broken.offset} of {size}"
        if not index.is_bag:
            raise BagError(
                f"{name}: cannot be read from {place} on ({broken.why}), before "
                "anything was recorded"
            ) from broken
        where = f"{place}: {broken.why}"

    messages = counted(index.n_scanned, "message")
    return index, f"{messages} recovered, up to {where}"


def _scan_records(file: BinaryIO, index: BagIndex, size: int) -> str:
    """Add all records up to the end of the data; the damage that costs no message."""
    damage = ""
    for record in records(file, len(MAGIC), size):
        try:
            match record.opcode:
                case Opcode.DATA_END:
                    return damage
                case Opcode.CHUNK:
                    index.add_chunk(record)
                case Opcode.SCHEMA | Opcode.CHANNEL | Opcode.METADATA:
                    index.describe(record)
                case Opcode.HEADER if record.offset == len(MAGIC):
                    index.library = record.parsed(mcap.Header.read).library
                case Opcode.MESSAGE:
                    raise Break(
                        record.offset,
                        "a message outside the chunks, which no checksum protects",
                    )
                case Opcode.MESSAGE_INDEX | Opcode.ATTACHMENT:
                    pass
                case _:
                    raise Break(record.offset, "no record of a recording begins there")
        except Break:
            # These hold no force, and the next record can be found.
            if record.opcode not in (Opcode.HEADER, Opcode.METADATA) or index.chunks:
                raise
            damage = f"the record at byte {record.offset} is damaged"
    raise Break(
        size, "it ends there without an index; its recorder was killed or still runs"
    )
