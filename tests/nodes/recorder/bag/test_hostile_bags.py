"""Bags whose checksums are right and whose content is wrong: never believed, never a traceback."""

import json
import zlib
from dataclasses import replace

import numpy as np
import pytest
from bags import PHI, frames, make_bag, record, skin_state
from mcap.records import ChunkIndex, MetadataIndex
from mcap.writer import Writer

from sparseskin.launch.commands.bag import info_document, info_lines
from sparseskin.messages import Measurements
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter
from sparseskin.nodes.recorder.convert.npz import export_npz

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
    try:
        with BagReader(path) as bag:
            assert all(line.isprintable() for line in info_lines(bag))
            json.dumps(info_document(bag))
            for written in export_npz(bag, out):
                written.unlink()
    except SparseskinError as error:
        line = str(error)
    else:
        line = ""
    assert line.isprintable()


def resealed(data):
    """A file with its two checksums made right."""
    start = int.from_bytes(data[-28:-20], "little")
    if 21 <= start <= len(data) - 37:
        data[start - 4 : start] = zlib.crc32(data[: start - 13]).to_bytes(4, "little")
    data[-12:-8] = zlib.crc32(data[max(0, start) : -12]).to_bytes(4, "little")
    return bytes(data)


@pytest.mark.parametrize(
    "text", [*("null", '{"/skin/taxels": null}', '{"/skin/taxels": {}}', "", "[" * 100_000)]
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
        *({"version": 99}, {"more": 1}),
    ],
)
def test_counts_that_cannot_be_are_counted_anew(forged, changes):
    path = forged(lambda name, v: forged_topics(v, **changes) if name == "topics" else v)
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


@pytest.mark.parametrize("fault", ["metadata beyond the end", "chunks listed again and again"])
def test_an_index_that_cannot_be_is_not_believed(tmp_path, monkeypatch, fault):
    metadata, chunk = MetadataIndex.write, ChunkIndex.write
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
