"""Recordings of ROS, .bag, .db3 and .mcap, and MCAP files of JSON, as files of readings."""

import heapq
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.array_files import MAX_GROWN_BYTES, MAX_GROWTH
from sparseskin.nodes.numerics.arrays import AnyArray
from sparseskin.nodes.recorder.bag.records import MAGIC as MCAP_MAGIC
from sparseskin.nodes.sensor.files.format import Format
from sparseskin.nodes.sensor.files.recording import (
    Block,
    File,
    Head,
    Recording,
    gathered,
)
from sparseskin.nodes.sensor.layout.checks import choose, reading, unreadable
from sparseskin.nodes.sensor.layout.layout import UnstatedError
from sparseskin.nodes.sensor.layout.tally import Tally

from .bags.bag_storage import MAGIC as BAG_MAGIC
from .bags.bag_storage import BagStorage
from .bags.db3_storage import Db3Storage
from .bags.mcap_storage import McapStorage
from .bags.metadata import Metadata, metadata_of
from .bags.storage import (
    CONVERT,
    Recorded,
    Storage,
    Topic,
    Workspace,
    decompressed,
    of_whole_pages,
    plain_message,
    with_log,
    workspace_of,
)
from .base import check_installed
from .frames import (
    LOG,
    NONE,
    STAMP,
    MessageReader,
    OtherFrameError,
    Received,
    Turns,
    fields_that_fit,
    size_text,
)
from .messages.definitions import Definitions
from .messages.grids import KINDS, EmptyMessageError, Numbers

SQLITE_MAGIC = b"SQLite format 3\0"
WINDOW = 1024
"""Messages that wait for one that was recorded before them; chosen: bags are nearly in order."""
WINDOW_BYTES = 1 << 24
MAX_TRIES = 100
"""Messages of a topic after which it holds no frames, if none of them does; chosen."""
MAX_FRAME_IDS = 8
SWAPPED_NS = 1_000_000_000
"""A stamp that falls by less is of a message that was overtaken, by more of a clock that was set;
chosen."""
EMPTY = "empty messages"
OTHER_FRAME = "messages of another frame_id"
SKIPPED = "skipped"
MALFORMED = "malformed messages"
OTHER_TYPE = "messages of another type"
OTHER_SHAPE = "messages of another shape"
IN_ORDER = "ros2 bag convert, or mcap sort, writes it in order"


class First(NamedTuple):
    """The first message of a topic that holds numbers: its reader, its fields that can be frames,
    and its own time.
    """

    reader: MessageReader
    fields: dict[str, Numbers]
    received: Received


class Stream(NamedTuple):
    """The messages that are read: their topic, and how."""

    topic: str
    reader: MessageReader
    first: Received
    # Their times are those of the recording.
    uses_log: bool
    notes: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the axes of a message."""
        return self.first.numbers.values.shape


class RosRecording(Recording):
    """The messages of a topic that hold numbers: the stated topic and field, or the only ones.

    Times are those of the headers, or of the recording where a header has none. Raises SourceError
    if nothing can be read, UnstatedError if several topics, fields or frames can be meant.
    """

    def __init__(self, file: File) -> None:
        check_installed(file.name, "ros", "rosbags", error=SourceError)
        self.tally = Tally("messages")
        self._layout = file.layout
        self._name = file.name
        if file.parts:
            self._name = str(Path(file.name).parent)
        # A bag of ROS 2 may be split into files that follow each other.
        paths = (file.name, *file.parts)
        self._work = workspace_of(paths)
        self._metadata = _metadata(paths)
        self._n_bytes = sum(Path(path).stat().st_size for path in paths)
        # What is not plain is decompressed once, whoever opens the recording how often.
        self._storages = [open_storage(path, self._work) for path in paths]
        self._is_closed = all(storage.is_closed for storage in self._storages)
        self._stream: Stream | None = None

    def head(self) -> Head:
        if self._stream is None:
            self._stream = self._choose()
        stream = self._stream
        time_unit = stream.reader.time_unit
        time_name = stream.reader.time_path
        if stream.uses_log:
            time_unit = "ns"
            time_name = "log time"
        return Head(
            stream.first.numbers.axes,
            is_timed=self._layout.time != NONE,
            time_unit=time_unit,
            time_name=time_name,
            asks_unit=not stream.reader.has_types,
            notes=stream.notes,
        )

    def blocks(self) -> Iterator[Block]:
        self.head()
        stream = self._stream
        assert stream is not None
        self.tally.begin()
        yield from gathered(self._frames(stream), self.tally)
        self._account(stream.topic)

    def _frames(self, stream: Stream) -> Iterator[tuple[AnyArray, int | float]]:
        """Numbers and times of messages."""
        dtype = stream.first.numbers.values.dtype.newbyteorder("=")
        is_stated = self._layout.n_stated is not None
        reads = _Reads(self._name, stream, self.tally, is_stated)
        turns = Turns()
        messages = in_order(self._messages((stream.topic,)))
        for n, message in enumerate(messages):
            if n < self._layout.skip:
                self.tally.drop(SKIPPED)
                continue
            received = reads.received(message)
            if received is None:
                continue

            # Several skins may send on one topic.
            if not self._layout.frame_id:
                self._check_frames(received, messages, stream, turns)
            time = reads.time(message, received, n + 1)
            yield received.numbers.values.astype(dtype, copy=False), time

    def _choose(self) -> Stream:
        """The topic and the field that are stated, or the only ones."""
        layout = self._layout
        topics = self._topics()
        if layout.topic:
            # A wrong name is answered with the topics and types that there are.
            kinds = {topic: described.kind for topic, described in topics.items()}
            choose(kinds, layout.topic, self._name, "topics")
            likely = [layout.topic]
        else:
            likely = self._likely(topics)

        firsts = self._firsts({topic: topics[topic] for topic in likely})
        # Each field of each topic that could be meant.
        choices: list[tuple[str, str]] = []
        for topic, of_topic in firsts.items():
            choices += [(topic, field) for field in of_topic.fields]
        # Never guessed: a wrong topic would be a wrong force.
        if len(choices) > 1:
            raise self._unstated(firsts, choices)
        topic, field = choices[0]
        of_topic = firsts[topic]
        reader = of_topic.reader
        notes = [f"topic {topic}"]
        if reader.field != field:
            reader.field = field
            notes.append(f"field {field}")

        received = of_topic.received._replace(numbers=of_topic.fields[field])
        # Drivers without a clock leave the stamps of their headers at zero.
        uses_log = layout.time == LOG or received.time is None
        if uses_log and reader.time_path == STAMP:
            notes.append("its headers have no stamps: times of the recording")
        if not self._is_closed:
            notes.append("its recorder was killed: what it wrote is read")
        return Stream(topic, reader, received, uses_log, tuple(notes))

    def _topics(self) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        for storage in self._storages:
            for topic, described in storage.topics().items():
                # Files of one bag describe the same topics: the first description is taken.
                topics.setdefault(topic, described)
        return topics

    def _likely(self, topics: dict[str, Topic]) -> list[str]:
        """Topics that can hold frames: of types that are frames by themselves, or that ROS does not
        have; or else all. Those without a message are left out.
        """
        counts: dict[str, int] = {}
        # The counts of a recorder that was killed are not true.
        if self._metadata and self._is_closed and any(self._metadata.counts.values()):
            counts = self._metadata.counts
        filled = [topic for topic in topics if counts.get(topic) != 0]
        likely = [topic for topic in filled if _may_hold_frames(topics[topic])]
        return likely or filled

    def _firsts(self, topics: dict[str, Topic]) -> dict[str, First]:
        """The first message with numbers of each topic that has one."""
        readers: dict[str, MessageReader] = {}
        faults: dict[str, str] = {}
        for topic, described in topics.items():
            try:
                readers[topic] = self._reader(described)
            except SourceError as error:
                faults[topic] = str(error)

        # Messages at the begin may be empty or malformed.
        firsts: dict[str, First] = {}
        tries = dict.fromkeys(readers, 0)
        for message in self._messages(readers):
            topic = message.topic
            if topic in firsts or tries[topic] >= MAX_TRIES:
                continue

            try:
                firsts[topic] = self._first(readers[topic], plain_message(message.data))
            except (EmptyMessageError, OtherFrameError) as error:
                faults.setdefault(topic, str(error))
            except UnstatedError as error:
                raise UnstatedError(
                    f"{self._name}: {topic}: {error}", *error.options
                ) from error
            except SourceError as error:
                faults[topic] = str(error)
                tries[topic] += 1
            if all(name in firsts or tries[name] >= MAX_TRIES for name in readers):
                break

        if not firsts:
            raise self._without_frames(topics, faults)
        return firsts

    def _without_frames(
        self, topics: dict[str, Topic], faults: dict[str, str]
    ) -> SourceError:
        """The error that no topic holds frames, with what was wrong with each."""
        if len(topics) == 1 and faults:
            (topic,) = topics
            (fault,) = faults.values()
            return SourceError(f"{self._name}: {topic}: {fault}")
        abouts = []
        for topic, described in [*topics.items()][:8]:
            about = printable(described.kind)
            if topic in faults:
                about = f"{about}: {faults[topic]}"
            abouts.append(f"{printable(topic)} ({about})")
        contents = ", ".join(abouts) or "no message"
        return SourceError(f"{self._name}: no topic holds frames; it holds {contents}")

    def _reader(self, described: Topic) -> MessageReader:
        if described.form == "json":
            return MessageReader(None, described.kind, self._layout)
        if not described.ros:
            kind = printable(described.kind)
            raise SourceError(
                f"its messages are in {kind}; read are those of ROS, and json"
            )
        definitions = Definitions(described.ros)
        if described.text:
            try:
                definitions.add(described.kind, described.text, described.form)
            except SourceError:
                if not definitions.is_of_ros(described.kind):
                    raise
        return MessageReader(definitions, described.kind, self._layout)

    def _first(self, reader: MessageReader, data: bytes) -> First:
        message = reader.decode(data)
        reader.check_frame(message)
        if reader.field:
            received = reader.read_frame(data)
            return First(reader, {reader.field: received.numbers}, received)

        fields = fields_that_fit(message, self._layout)
        if not fields:
            raise EmptyMessageError("holds no list of numbers")
        numbers = next(iter(fields.values()))
        received = reader.received(numbers, message)
        return First(reader, fields, received)

    def _unstated(
        self, firsts: dict[str, First], choices: list[tuple[str, str]]
    ) -> UnstatedError:
        """The error that names the topics and fields of which each can be meant."""
        options = []
        texts = []
        for topic, field in choices:
            option = {}
            if not self._layout.topic:
                option["topic"] = topic
            if field and field != self._layout.field:
                option["field"] = field
            options.append(option)
            kind = firsts[topic].reader.kind.rpartition("/")[2]
            size = size_text(firsts[topic].fields[field])
            place = f"{printable(topic)} {printable(field)}".strip()
            texts.append(f"{place} {kind} {size}")
        noun = "topics of frames" if len(firsts) == len(choices) else "fields of frames"
        fault = f"holds {len(choices)} {noun}, which is not stated: {', '.join(texts)[:400]}"
        keys = " and ".join(dict.fromkeys(key for option in options for key in option))
        return UnstatedError(f"{self._name}: {fault}; state {keys}", *options)

    def _check_frames(
        self,
        received: Received,
        messages: Iterator[Recorded],
        stream: Stream,
        turns: Turns,
    ) -> None:
        """Raise UnstatedError if a message is of another frame than the first one, or of another
        skin, whose messages take turns.
        """
        # The frame is compared with the first; a number is noticed by its turns.
        is_of_frame = received.frame_id == stream.first.frame_id
        if is_of_frame and not turns.add(received.number):
            return

        # A few more messages tell which frames there are.
        def skin_of(message: Received) -> str:
            return message.number if is_of_frame else message.frame_id

        frame_ids = {skin_of(stream.first): None, skin_of(received): None}
        for message in messages:
            try:
                frame = stream.reader.read_frame(plain_message(message.data))
            except SourceError:
                continue
            frame_ids[skin_of(frame)] = None
            if len(frame_ids) >= MAX_FRAME_IDS:
                break
        names = ", ".join(repr(printable(frame_id[:40])) for frame_id in frame_ids)
        fault = f"{stream.topic}: messages of {len(frame_ids)} frames, {names}"
        options = [{"frame_id": frame_id} for frame_id in frame_ids if frame_id]
        raise UnstatedError(f"{self._name}: {fault}; state frame_id", *options)

    def _messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """All messages of some topics; SourceError once they are larger than any recording of that
        size is.
        """
        # A forged file may decompress without end.
        room_bytes = max(MAX_GROWN_BYTES, MAX_GROWTH * self._n_bytes)
        for storage in self._storages:
            try:
                for message in storage.messages(topics):
                    room_bytes -= len(message.data)
                    if room_bytes < 0:
                        raise SourceError(
                            f"{self._name}: its messages are far larger than the file"
                        )
                    yield message
            except (ValueError, KeyError, OverflowError) as error:
                # Of malformed bytes.
                raise unreadable(storage.name, error) from error

    def _account(self, topic: str) -> None:
        """Name the messages that the file does not hold, as far as their number is known."""
        # Not every recording has a metadata.yaml that counts its messages.
        n_stated = None
        if self._metadata:
            n_stated = self._metadata.counts.get(topic)
        n_missing = (n_stated or 0) - self.tally.n_items
        losses = [loss for storage in self._storages for loss in storage.losses]
        if n_missing > 0:
            place = f", {losses[0]}" if losses else ""
            self.tally.drop(
                f"missing of the {n_stated} that metadata.yaml states{place}", n_missing
            )
        elif n_missing < 0 or n_stated is None:
            for loss in losses:
                self.tally.drop(f"or more lost {loss}")


class _Reads:
    """Reads the messages of a stream, and drops by name those that hold no frame."""

    def __init__(
        self, name: str, stream: Stream, tally: Tally, is_stated: bool
    ) -> None:
        self._where = f"{name}: {stream.topic}"
        self._stream = stream
        self._tally = tally
        self._is_stated = is_stated
        self._last_time: int | float | None = None

    def received(self, message: Recorded) -> Received | None:
        """What a message holds; None if it is dropped. Raises SourceError if its shape changes."""
        if message.kind != self._stream.reader.kind:
            self._tally.drop(OTHER_TYPE)
            return None
        try:
            received = self._stream.reader.read_frame(plain_message(message.data))
        except EmptyMessageError:
            self._tally.drop(EMPTY)
        except OtherFrameError:
            self._tally.drop(OTHER_FRAME)
        except SourceError:
            self._tally.drop(MALFORMED)
        else:
            if self._has_shape(received):
                return received
        return None

    def time(self, message: Recorded, received: Received, number: int) -> int | float:
        """The time of a message, of which this is the number. Raises UnstatedError if stamps of
        headers fall, or one is missing.
        """
        uses_log = self._stream.uses_log
        time = message.log_ns if uses_log else received.time
        place = f"{self._where}: message {number}"
        is_header_time = not uses_log and self._stream.reader.time_unit == "ns"
        last_time = self._last_time or 0
        if time is None or (is_header_time and time < last_time):
            fault = "its stamp is before that of the one before it, or missing"
            hint = f"state time={LOG}, the times of the recording"
            fall_ns = last_time - (time or 0)
            if time and fall_ns < SWAPPED_NS:
                # By the times of the recording, the frames would keep a wrong order.
                raise SourceError(
                    f"{place}: {fault}, by {fall_ns / 1e9:.3g} s; {hint} and order"
                )
            raise UnstatedError(f"{place}: {fault}; {hint}", {"time": LOG})
        if uses_log and time < last_time:
            raise SourceError(
                f"{place}: was recorded before more than {WINDOW} messages that stand "
                f"before it; {IN_ORDER}"
            )
        self._last_time = time
        return time

    def _has_shape(self, received: Received) -> bool:
        shape = received.numbers.values.shape
        if shape == self._stream.shape:
            self._check_names(received)
            return True
        if self._is_stated:
            self._tally.drop(OTHER_SHAPE)
            return False
        shapes = f"{size_text(self._stream.first.numbers)}, then {size_text(received.numbers)}"
        raise SourceError(
            f"{self._where}: its shape changes: {shapes}; state n_rows and n_cols: "
            "messages of other shapes are left out"
        )

    def _check_names(self, received: Received) -> None:
        """Raise SourceError if a message has its taxels in another order than the first one."""
        axes = received.numbers.axes
        first_axes = self._stream.first.numbers.axes
        if axes is first_axes:
            return
        if [axis.names for axis in axes] != [axis.names for axis in first_axes]:
            raise SourceError(
                f"{self._where}: the order of its taxels changes, as named in it"
            )


def open_storage(path: str, work: Workspace) -> Storage:
    """A file of recorded messages, by its begin, decompressed where needed. Raises SourceError if
    it is none.
    """
    with reading(path) as file:
        begin = file.read(len(SQLITE_MAGIC))
    if begin == SQLITE_MAGIC:
        # What a killed recorder left in the log of SQLite is read, too.
        complete = with_log(path, work)
        if complete != path:
            return Db3Storage(complete, path, has_log=True)
        return Db3Storage(of_whole_pages(path, work), path)
    # The form is seen behind the compression, whatever the name ends in.
    plain = decompressed(path, work)
    with reading(plain) as file:
        begin = file.read(len(SQLITE_MAGIC))
    if begin == SQLITE_MAGIC:
        return Db3Storage(of_whole_pages(plain, work), path)
    if begin.startswith(MCAP_MAGIC):
        return McapStorage(plain, path)
    if begin.startswith(BAG_MAGIC):
        return BagStorage(plain, path)
    raise SourceError(f"{path}: is no .bag, .db3 or .mcap of ROS; if it is {CONVERT}")


def _may_hold_frames(topic: Topic) -> bool:
    if not topic.ros or topic.kind in KINDS:
        return True
    return not Definitions(topic.ros).is_of_ros(topic.kind)


def in_order(messages: Iterator[Recorded]) -> Iterator[Recorded]:
    """Messages in the order of the times at which they were recorded, as far as each is at most
    `WINDOW` messages, or `WINDOW_BYTES`, from its place.
    """
    waiting: list[tuple[int, int, Recorded]] = []
    n_bytes = 0
    for number, message in enumerate(messages):
        # The number keeps messages of one time in their order.
        heapq.heappush(waiting, (message.log_ns, number, message))
        n_bytes += len(message.data)
        while len(waiting) > WINDOW or n_bytes > WINDOW_BYTES:
            _, _, earliest = heapq.heappop(waiting)
            n_bytes -= len(earliest.data)
            yield earliest
    while waiting:
        _, _, earliest = heapq.heappop(waiting)
        yield earliest


def _metadata(paths: tuple[str, ...]) -> Metadata | None:
    """The metadata of a bag whose files are all read; None: of others. Raises SourceError if its
    messages are compressed in a form that is not read.
    """
    metadata = metadata_of(Path(paths[0]).parent)
    if metadata is None:
        return None
    # It may name the files as they were before they were compressed.
    names = {Path(path).name.removesuffix(".zstd") for path in paths}
    if names != {name.removesuffix(".zstd") for name in metadata.files}:
        return None
    if metadata.mode not in ("", "none") and metadata.form not in ("", "zstd"):
        raise SourceError(f"{paths[0]}: {metadata.form} is not read; {CONVERT}")
    return metadata


_SUFFIXES = {
    ".bag": "ROS 1",
    ".db3": "ROS 2",
    ".mcap": "ROS 2",
    ".active": "ROS 1, of a killed recorder",
    ".zstd": "ROS 2, compressed",
}
ROS = Format(_SUFFIXES, RosRecording)
