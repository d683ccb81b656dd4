"""The writer: what reaches the disk, when, and what happens if it does not; hostile bags."""

import json
import zlib
from dataclasses import replace

import mcap.reader
import numpy as np
import pytest
from bags import (
    LAG_NS,
    PERIOD_NS,
    PHI,
    frame,
    frames,
    make_bag,
    on_disk,
    record,
    skin_state,
)
from damaged import refusal
from mcap.records import ChunkIndex, MetadataIndex
from mcap.writer import Writer

from sparseskin.launch.commands.bag import info_document, info_lines
from sparseskin.messages import End, Measurements, encode
from sparseskin.messages.base import omitted_fields
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.recorder.bag.format import BagError, BagMessage
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter, json_schema
from sparseskin.nodes.recorder.convert.npz import export_npz


def test_what_was_written_is_read_back_byte_for_byte_and_in_order(tmp_path):
    path = tmp_path / "a.mcap"
    messages = frames(100)
    payloads = make_bag(path, messages)
    with BagReader(path) as bag:
        found = list(bag.messages())
        assert bag.metadata == {"scene": "test", "seed": "3"}
        assert bag.counts == {"lost": {"/skin/taxels": 2}}
    assert [message.payload for message in found] == payloads
    assert [message.topic for message in found] == [
        message.topic for message in messages
    ]
    assert [message.stamp_ns for message in found] == [
        message.stamp_ns for message in messages
    ]
    assert all(message.log_time_ns == message.stamp_ns + LAG_NS for message in found)
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.mcap"]


def test_it_is_an_mcap_that_describes_its_own_schemas(tmp_path):
    make_bag(tmp_path / "a.mcap", frames(3))
    with open(tmp_path / "a.mcap", "rb") as file:
        reader = mcap.reader.make_reader(file, validate_crcs=True)
        header = reader.get_header()
        summary = reader.get_summary()
        assert len(list(reader.iter_messages())) == 1 + 3 * 4
    assert header.library.startswith("sparseskin ")
    assert {channel.message_encoding for channel in summary.channels.values()} == {
        "msgpack"
    }
    versions = {
        c.topic: c.metadata["schema_version"] for c in summary.channels.values()
    }
    assert versions.pop("/skin/skin") == "1"
    assert set(versions.values()) == {"2"}
    assert {(schema.name, schema.encoding) for schema in summary.schemas.values()} == {
        (f"sparseskin/{name}", "jsonschema")
        for name in ("skin", "taxels", "truth", "measurements", "reconstruction")
    }
    assert {index.compression for index in summary.chunk_indexes} == {"lz4"}
    counts = summary.statistics
    assert counts.message_count == 13
    assert counts.schema_count == 5
    assert counts.channel_count == 5
    assert counts.metadata_count == 3
    assert counts.attachment_count == 0
    assert counts.message_start_time == LAG_NS
    assert counts.message_end_time == 2 * PERIOD_NS + LAG_NS


@pytest.mark.parametrize("name", SCHEMAS)
def test_every_message_has_a_json_schema_that_names_its_fields(name):
    schema = json_schema(SCHEMAS[name])
    assert schema["properties"]["schema"] == {"const": name}
    always = [
        key for key in schema["properties"] if key not in omitted_fields(SCHEMAS[name])
    ]
    assert schema["required"] == always
    assert {"stamp_ns", "patch", "run_id", "seq"} < schema["properties"].keys()


def test_the_end_of_a_stream_is_kept_but_not_counted_as_a_frame(tmp_path):
    path = tmp_path / "a.mcap"
    end = End(stamp_ns=99, patch="skin", of="taxels", n_messages=1)
    payloads = make_bag(path, [frame(0)[0], end])
    with BagReader(path) as bag:
        assert bag.topics["/skin/taxels"].n_messages == 1
        assert bag.topics["/skin/taxels"].schema == "taxels"
        assert [message.payload for message in bag.messages()] == payloads


@pytest.mark.parametrize("taken", ["a.mcap", "a.mcap.part"])
def test_nothing_is_overwritten_and_no_link_followed(tmp_path, taken):
    (tmp_path / "other").write_bytes(b"precious")
    (tmp_path / taken).symlink_to("other")
    with pytest.raises(BagError, match="exists already"):
        BagWriter(tmp_path / "a.mcap", {})
    assert (tmp_path / "other").read_bytes() == b"precious"


def test_a_file_that_took_the_name_meanwhile_is_not_overwritten(tmp_path):
    path = tmp_path / "a.mcap"
    writer = BagWriter(path, {})
    payload = record(writer, frame(0)[0])
    path.write_bytes(b"precious")
    with pytest.raises(BagError, match=r"the recording is complete in a\.mcap\.part"):
        writer.close()
    assert path.read_bytes() == b"precious"
    assert on_disk(path) == [payload]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.bag", "ends in .mcap"),
        ("none/a.mcap", "folder does not exist"),
        ("a\0.mcap", "null"),
    ],
)
def test_a_path_that_cannot_be_written_is_named(tmp_path, name, text):
    with pytest.raises(BagError, match=text):
        BagWriter(tmp_path / name, {})


def test_what_cannot_be_recorded_is_refused_and_harms_nothing(tmp_path):
    path = tmp_path / "a.mcap"
    with BagWriter(path, {}) as writer:
        good = record(writer, frame(0)[0])
        with pytest.raises(BagError, match="did you mean 'taxels'"):
            writer.write(BagMessage("/skin/taxel", "taxel", 1, 1, b"x"))
    with BagReader(path) as bag:
        assert [message.payload for message in bag.messages()] == [good]


def test_a_closed_bag_accepts_nothing(tmp_path):
    writer = BagWriter(tmp_path / "a.mcap", {})
    writer.close()
    writer.close()
    with pytest.raises(BagError, match="closed"):
        record(writer, frame(0)[0])
    with BagReader(tmp_path / "a.mcap") as bag:
        assert bag.topics == {}
        assert list(bag.messages()) == []
        assert bag.recovered == ""


@pytest.fixture
def small_disk(mount_disk):
    return mount_disk("400k")


def fill(writer):
    """Write until the disk is full; what the writer was given."""
    payloads = []
    for k in range(100_000):
        payloads.append(encode(frame(k)[0])[1])
        try:
            record(writer, frame(k)[0])
            if k % 20 == 19:
                writer.flush()
        except BagError:
            return payloads
    raise AssertionError("the disk is not full")


def test_a_full_disk_is_one_line_and_what_was_written_can_be_read(small_disk):
    path = small_disk / "a.mcap"
    writer = BagWriter(path, {"scene": "full"})
    payloads = fill(writer)
    size = writer.part.stat().st_size
    errors = []
    for _ in range(2):
        with pytest.raises(BagError) as caught:
            record(writer, frame(0)[0])
        errors.append(str(caught.value))
    writer.close()
    assert errors[0] == errors[1]
    assert "\n" not in errors[0]
    assert str(path) in errors[0]
    assert "No space left on device" in errors[0]
    assert writer.part.stat().st_size == size
    found = on_disk(path)
    assert found == payloads[: len(found)]
    assert len(payloads) - len(found) <= 20
    with BagReader(writer.part) as bag:
        assert (
            f"up to byte {size} of {size}: it ends there without an index"
            in bag.recovered
        )


def test_a_disk_that_is_full_at_the_end_loses_the_index_alone(small_disk):
    path = small_disk / "a.mcap"
    writer = BagWriter(path, {"scene": "full"})
    payloads = [record(writer, frame(k)[0]) for k in range(20)]
    writer.flush()
    with pytest.raises(OSError, match="No space left"):
        (small_disk / "other").write_bytes(bytes(1 << 20))
    with pytest.raises(BagError, match="No space left on device"):
        writer.close({"lost": {f"/p/t{k}": k for k in range(2000)}})
    writer.close()
    assert not path.exists()
    assert on_disk(path) == payloads


def test_a_disk_full_from_the_start_is_refused_and_leaves_no_file(small_disk):
    with pytest.raises(OSError, match="No space left"):
        (small_disk / "other").write_bytes(bytes(1 << 20))
    with pytest.raises(BagError, match="No space left on device"):
        BagWriter(small_disk / "a.mcap", {"launch": "x" * 10_000})
    assert [entry.name for entry in small_disk.iterdir()] == ["other"]


N_FRAMES = 6


@pytest.fixture
def forged(tmp_path, monkeypatch):
    """A bag whose metadata records are forged; the rest, and all checksums, are right."""

    def make(forge):
        add = Writer.add_metadata
        path = tmp_path / "a.mcap"
        with monkeypatch.context() as patch:
            patch.setattr(
                Writer,
                "add_metadata",
                lambda self, name, values: add(self, name, forge(name, values)),
            )
            make_bag(path, frames(N_FRAMES))
        return path

    return make


def forged_topics(values, **changes):
    topics = json.loads(values["json"])
    for info in topics.values():
        info.update(changes)
    return {"json": json.dumps(topics)}


def look(path, out):
    """All that a user does with a bag; what is refused is one line that can be printed."""

    def used():
        with BagReader(path) as bag:
            assert all(line.isprintable() for line in info_lines(bag))
            json.dumps(info_document(bag))
            for written in export_npz(bag, out):
                written.unlink()

    refusal(used)


def resealed(data):
    """A file with its two checksums made right."""
    start = int.from_bytes(data[-28:-20], "little")
    if 21 <= start <= len(data) - 37:
        data[start - 4 : start] = zlib.crc32(data[: start - 13]).to_bytes(4, "little")
    data[-12:-8] = zlib.crc32(data[max(0, start) : -12]).to_bytes(4, "little")
    return bytes(data)


@pytest.mark.parametrize(
    "text",
    [*("null", '{"/skin/taxels": null}', '{"/skin/taxels": {}}', "", "[" * 100_000)],
)
@pytest.mark.parametrize("which", ["topics", "counts"])
def test_metadata_of_any_json_are_read_past(forged, tmp_path, which, text):
    path = forged(lambda name, values: {"json": text} if name == which else values)
    with BagReader(path) as bag:
        assert sum(1 for _ in bag.messages()) == 4 * N_FRAMES + 1
    look(path, tmp_path / "out.npz")


@pytest.mark.parametrize(
    "changes",
    [
        *({"n_messages": n} for n in (-5, 2**70, True, None)),
        *({"first_ns": 5, "last_ns": 4}, {"min_lag_ns": 2**70}, {"schema": "truth"}),
        {"more": 1},
    ],
)
def test_counts_that_cannot_be_are_counted_anew(forged, changes):
    path = forged(
        lambda name, v: forged_topics(v, **changes) if name == "topics" else v
    )
    with BagReader(path) as bag:
        assert bag.topics["/skin/taxels"].n_messages == N_FRAMES
        assert bag.topics["/skin/taxels"].schema == "taxels"


def test_one_long_frame_among_short_ones_is_not_padded_without_limit(tmp_path):
    path = tmp_path / "a.mcap"
    with BagWriter(path, {}) as writer:
        record(writer, skin_state())
        for k, m in enumerate((100_000, *[1] * 100)):
            y = np.zeros(m, np.float32)
            record(writer, Measurements(stamp_ns=k, patch="skin", y=y, phi=PHI))
        writer.close({})
    text = "/skin/measurements: 100100 numbers would be padded to 10100000"
    with BagReader(path) as bag, pytest.raises(BagError, match=text):
        export_npz(bag, tmp_path / "out.npz")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "fault", ["metadata beyond the end", "chunks listed again and again"]
)
def test_an_index_that_cannot_be_is_not_believed(tmp_path, monkeypatch, fault):
    metadata = MetadataIndex.write
    chunk = ChunkIndex.write
    if fault == "metadata beyond the end":
        beyond = lambda self, out: metadata(replace(self, offset=2**60), out)  # noqa: E731
        monkeypatch.setattr(MetadataIndex, "write", beyond)
    else:
        again = lambda self, out: [chunk(self, out) for _ in range(50)]  # noqa: E731
        monkeypatch.setattr(ChunkIndex, "write", again)
    payloads = make_bag(tmp_path / "a.mcap", frames(N_FRAMES))
    with BagReader(tmp_path / "a.mcap") as bag:
        assert [message.payload for message in bag.messages()] == payloads


def test_texts_of_any_length_and_kind_are_a_short_printable_table(tmp_path):
    path = tmp_path / "a.mcap"
    foreign = "\x1b]0;x\x07\u202e"
    metadata = {
        "launch": "w" * 8_000_000,
        foreign: foreign,
        "phi": json.dumps({foreign: foreign}),
        "versions": '{"a":' * 900 + "1" + "}" * 900,
    }
    with BagWriter(path, metadata) as writer:
        record(writer, skin_state())
        writer.close({foreign: {foreign: 1}, "lost": {"/skin/skin": foreign}})
    with BagReader(path) as bag:
        table = "\n".join(info_lines(bag))
    assert len(table) < 10_000
    assert all(line.isprintable() for line in table.split("\n"))


def test_a_mutated_bag_with_right_checksums_is_read_or_refused_in_one_line(tmp_path):
    path = tmp_path / "a.mcap"
    make_bag(path, frames(2), flush_every=3)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(60):
        data = bytearray(whole)
        # The end, of which most is the index, is changed as often as all before it.
        first = len(data) // 2 if rng.integers(2) else 8
        for _ in range(rng.integers(1, 4)):
            data[int(rng.integers(first, len(data) - 8))] = int(rng.integers(256))
        path.write_bytes(resealed(data))
        look(path, tmp_path / "out.npz")
