"""The reader: whole, cut, damaged and foreign files; never a force that was not recorded."""

import os
import random
import re
import tracemalloc
import zlib

import lz4.frame
import mcap.writer
import pytest
from bags import frames, make_bag
from damaged import refusal
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk

from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.recorder.bag.format import BagError, BagMessage
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.records import (
    HEAD_BYTES,
    MAGIC,
    MAX_CHUNK_BYTES,
    Break,
    Record,
    open_chunk,
    records,
)
from sparseskin.nodes.recorder.bag.writer import BagWriter
from sparseskin.nodes.sensor.files.file_source import open_file

N_FRAMES = 60


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The bytes of a bag, and the payloads in it."""
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    payloads = make_bag(path, frames(N_FRAMES), flush_every=24)
    return path.read_bytes(), payloads


def survivors(path, data):
    """The messages read from a file with these bytes, and the warnings; None if it is refused."""
    path.write_bytes(data)
    found = []

    def read():
        with BagReader(path) as bag:
            found[:] = [message.payload for message in bag.messages()], bag.recovered

    line = refusal(read, BagError)
    assert not line or line.startswith(f"{path}: ")
    return found or None


def check_damaged(path, data, payloads):
    """A damaged file gives the first payloads and their number, or is refused."""
    found = survivors(path, data)
    if found is None:
        return 0
    read, recovered = found
    assert read == payloads[: len(read)]
    assert re.match(rf"{len(read)} messages? recovered, up to ", recovered)
    return len(read)


def chunk_ends(data):
    """Where each chunk record ends."""
    ends = []
    offset = 8
    while offset < len(data) - 8:
        length = int.from_bytes(data[offset + 1 : offset + 9], "little")
        offset += 9 + length
        if data[offset - 9 - length] == 6:
            ends.append(offset)
    return ends


@pytest.mark.parametrize("cut", [True, False])
def test_of_a_damaged_file_what_comes_before_is_delivered(whole, tmp_path, cut):
    data, payloads = whole
    ends = chunk_ends(data)
    assert len(ends) > 8
    rng = random.Random(0)
    for _ in range(40):
        at = rng.randrange(0 if cut else 600, len(data))
        damaged = bytearray(data[:at] if cut else data)
        if not cut:
            damaged[at] ^= rng.randrange(1, 256)
        n_read = check_damaged(tmp_path / "a.mcap", bytes(damaged), payloads)
        complete = min(24 * sum(end <= at for end in ends), len(payloads))
        assert n_read == complete if cut else n_read >= complete


def test_a_length_that_is_far_too_large_takes_no_memory(whole, tmp_path):
    data, payloads = whole
    compression = data.index(b"\x03\x00\x00\x00lz4")
    length_of_data = compression + 7
    tracemalloc.start()
    try:
        # Of the record, of what is in the chunk, and of its compressed data.
        for at in (compression - 36, compression - 12, length_of_data):
            for size in (1 << 31, (1 << 64) - 1):
                damaged = data[:at] + size.to_bytes(8, "little") + data[at + 8 :]
                n_read = check_damaged(tmp_path / "a.mcap", damaged, payloads)
                # The last of the three is not needed where a checksum proves the chunk.
                assert n_read == 0 or at == length_of_data
        assert tracemalloc.get_traced_memory()[1] < 10 * len(data)
    finally:
        tracemalloc.stop()


def test_stamps_that_are_recorded_out_of_order_are_all_found(tmp_path):
    path = tmp_path / "a.mcap"
    rng = random.Random(2)
    stamps = [rng.randrange(10**6) for _ in range(300)]
    with BagWriter(path, {}) as writer:
        for k, stamp in enumerate(stamps):
            writer.write(BagMessage("/skin/taxels", "taxels", k, stamp, b"x"))
            if k % 10 == 0:
                writer.flush()
    with BagReader(path) as bag:
        for start, stop in ((0, 50_000), (300_000, 350_000), (950_000, 10**7)):
            found = [message.stamp_ns for message in bag.messages(None, start, stop)]
            assert found == [stamp for stamp in stamps if start <= stamp < stop]
            assert found
        assert bag.topics["/skin/taxels"].first_ns == min(stamps)
        assert bag.topics["/skin/taxels"].last_ns == max(stamps)


def test_a_topic_that_is_not_there_is_named_at_once(whole, tmp_path):
    (tmp_path / "a.mcap").write_bytes(whole[0])
    with BagReader(tmp_path / "a.mcap") as bag:
        with pytest.raises(BagError, match="did you mean '/skin/truth'"):
            bag.messages(["/skin/truths"])
        with pytest.raises(BagError, match="known: /skin/measurements, /skin/recon"):
            bag.messages(["/x/y"])


def test_a_file_that_changes_while_it_is_read_is_an_error_and_no_force(whole, tmp_path):
    data, payloads = whole
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    with BagReader(path) as bag:
        messages = bag.messages()
        assert next(messages).payload == payloads[0]
        middle = chunk_ends(data)[3] - 40
        with open(path, "r+b") as file:
            file.seek(middle)
            file.write(b"\0" * 8)
        with pytest.raises(BagError, match="was changed while it was read"):
            list(messages)
    with pytest.raises(BagError, match="closed"):
        next(bag.messages())


def test_damage_of_a_bag_that_is_not_checked_whole_is_found_as_it_is_read(
    whole, tmp_path
):
    data, payloads = whole
    path = tmp_path / "a.mcap"
    end = chunk_ends(data)[3]
    path.write_bytes(data[: end - 40] + b"\0" * 8 + data[end - 32 :])
    with BagReader(path) as bag:
        recovered = bag.recovered
        n_readable = sum(1 for _ in bag.messages())
        assert recovered
    with BagReader(path, whole=False) as bag:
        assert bag.recovered == ""
        assert bag.topics["/skin/taxels"].n_messages == N_FRAMES
        messages = bag.messages()
        found = [next(messages).payload for _ in range(n_readable)]
        with pytest.raises(BagError, match="is damaged"):
            next(messages)
    assert found == payloads[:n_readable]
    path.write_bytes(data[:end])  # without an index it is scanned in any case
    with BagReader(path, whole=False) as bag:
        assert bag.recovered


def test_a_bag_that_another_tool_wrote_anew_can_be_read(whole, tmp_path):
    data, payloads = whole
    (tmp_path / "a.mcap").write_bytes(data)
    for compression in mcap.writer.CompressionType:
        path = tmp_path / f"{compression.name}.mcap"
        with BagReader(tmp_path / "a.mcap") as bag, open(path, "wb") as file:
            writer = mcap.writer.Writer(file, compression=compression)
            writer.start(library="some tool")
            channels = {}
            for one in bag.messages():
                if one.topic not in channels:
                    schema = writer.register_schema(f"sparseskin/{one.schema}", "", b"")
                    version = {"schema_version": str(SCHEMAS[one.schema].version)}
                    channels[one.topic] = writer.register_channel(
                        one.topic, "msgpack", schema, version
                    )
                writer.add_message(
                    channels[one.topic], one.log_time_ns, one.payload, one.stamp_ns
                )
            writer.finish()
        with BagReader(path) as bag:
            assert [message.payload for message in bag.messages()] == payloads
            assert bag.metadata == {}
            assert bag.counts is None
            assert bag.recovered == ""


TAXELS = {"encoding": "msgpack", "schema": "sparseskin/taxels", "topic": "/skin/taxels"}


def foreign(path, chunked=True, n=1, version="2", **changes):
    """A file of another program with n messages, by default as of taxels."""
    of = TAXELS | changes
    with open(path, "wb") as file:
        writer = mcap.writer.Writer(file, use_chunking=chunked)
        writer.start(library="robot logger 7")
        for _ in range(n):
            schema = writer.register_schema(of["schema"], "", b"")
            stated = {"schema_version": version}
            channel = writer.register_channel(
                of["topic"], of["encoding"], schema, stated
            )
            writer.add_message(channel, 1, b"payload", 1)
        writer.finish()


def ros2_folder(path):
    path.mkdir()
    (path / "metadata.yaml").touch()


BAD = {
    "missing": (lambda path: None, "no such file"),
    "not complete": (
        lambda path: path.with_name("a.mcap.part").touch(),
        "a.mcap.part is there: not complete, but can be read",
    ),
    "empty": (lambda path: path.touch(), "is empty"),
    "pipe": (os.mkfifo, "is no regular file"),
    "ROS 2": (
        lambda path: foreign(path, encoding="cdr", schema="std_msgs/msg/String"),
        "ros2 bag play its folder",
    ),
    "folder of ROS 2": (
        ros2_folder,
        "is a folder; expected a recording, NAME.mcap; it is for",
    ),
    "Foxglove": (
        lambda path: foreign(path, encoding="protobuf", schema="foxglove.Grid"),
        "Foxglove and Lichtblick open it",
    ),
    "text": (lambda path: path.write_text("stamp,force\n" * 9), "not an MCAP file"),
    "magic alone": (
        lambda path: path.write_bytes(mcap.writer.MCAP0_MAGIC),
        "before anything was recorded",
    ),
    "another program, no message": (
        lambda path: foreign(path, n=0),
        "another program (library 'robot logger 7')",
    ),
    "not msgpack": (lambda path: foreign(path, encoding="json"), "'json' messages"),
    "newer": (
        lambda path: foreign(path, version="3"),
        "recorded with taxels version 3; this program reads 2",
    ),
    "of 0.1.0": (
        lambda path: foreign(path, version="1"),
        "topic /skin/taxels: recorded with taxels version 1; this program reads 2",
    ),
    "several patches, of 0.1.0": (
        lambda path: foreign(path, schema="sparseskin/taxels_batch", version="1"),
        "topic /skin/taxels holds messages of schema 'taxels_batch'; this program reads skin, ",
    ),
    "unknown schema": (
        lambda path: foreign(path, schema="sparseskin/smell"),
        "schema 'smell'",
    ),
    "topic": (
        lambda path: foreign(path, topic="/../../etc/passwd"),
        "expected /PATCH/SCHEMA",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_bag_is_refused_in_one_line(tmp_path, name):
    make, text = BAD[name]
    path = tmp_path / "a.mcap"
    make(path)
    shown = refusal(lambda: BagReader(path), BagError)
    assert text in shown
    assert shown.startswith(f"{path}: ")


def test_a_chunk_whose_checksum_was_not_computed_is_read(tmp_path):
    path = tmp_path / "a.mcap"
    make_bag(path, frames(3))
    with BagReader(path) as bag:
        n_messages = len(list(bag.messages()))
    with path.open("rb") as file:
        chunks = [
            r
            for r in records(file, len(MAGIC), path.stat().st_size - 8)
            if r.opcode == 6
        ]
    raw = bytearray(path.read_bytes())
    for chunk in chunks:  # after its first and last time and its size
        at = chunk.offset + HEAD_BYTES + 24
        raw[at : at + 4] = bytes(4)
    path.write_bytes(raw)
    with BagReader(path) as bag:
        assert len(list(bag.messages())) == n_messages
    assert open_file(path).n_frames == 3


def test_messages_that_no_checksum_protects_are_not_delivered(tmp_path):
    foreign(tmp_path / "a.mcap", chunked=False)
    with BagReader(tmp_path / "a.mcap") as bag:
        assert list(bag.messages()) == []
        assert bag.recovered.endswith(
            "a message outside the chunks, which no checksum protects"
        )


def test_a_chunk_that_decompresses_to_too_much_is_refused():
    def chunk_of(n_bytes):
        plain = bytes(n_bytes)
        builder = RecordBuilder()
        packed = lz4.frame.compress(plain)
        Chunk("lz4", packed, 0, 0, zlib.crc32(plain), n_bytes).write(builder)
        return Record(Opcode.CHUNK, 0, builder.end()[HEAD_BYTES:])

    assert len(open_chunk(chunk_of(MAX_CHUNK_BYTES))) == MAX_CHUNK_BYTES
    with pytest.raises(Break, match=f"at most {MAX_CHUNK_BYTES}"):
        open_chunk(chunk_of(MAX_CHUNK_BYTES + 1))
