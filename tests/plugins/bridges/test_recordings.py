"""Recordings of ROS 1 and ROS 2, drawn at random and written by rosbags, as files of readings."""

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from damaged import mutated, refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("rosbags", reason="rosbags is not installed")
from drawn_messages import (
    BEGIN_NS,
    PERIOD_NS,
    TOPIC,
    Grid,
    Sent,
    files_of,
    frames_sent,
    grids,
    interleaved,
    message_of,
    registered,
    store_of,
    stream_store,
    write_bag,
)
from rosbags import rosbag2
from rosbags.rosbag2.enums import StoragePlugin

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.files.recording import File
from sparseskin.nodes.sensor.layout.arrangement import arrange
from sparseskin.nodes.sensor.layout.layout import EMPTY, Layout, UnstatedError
from sparseskin.plugins.bridges import cdr
from sparseskin.plugins.bridges.messages.grids import ARRAYS
from sparseskin.plugins.bridges.recordings import WINDOW, RosRecording, in_order

STORAGES = ("bag", "db3", "mcap")
IMAGES = Grid("image", 3, 4, "<u2")
any_folder = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    deadline=None,
    max_examples=40,
)


class Read:
    """All that a recording holds; raises as it does."""

    def __init__(self, path, layout=EMPTY):
        names = (
            [str(file) for file in files_of(path)] if isinstance(path, Path) else path
        )
        with Path(names[0]).open("rb") as opened:
            recording = RosRecording(File(opened, names[0], tuple(names[1:]), layout))
            head = recording.head()
            places = arrange(layout, head.axes, names[0])
            blocks = list(recording.blocks())
        self.frames = [
            frame for block in blocks for frame in places.frames(block.numbers)
        ]
        self.times = [time for block in blocks for time in block.times]
        self.notes = head.notes
        self.tally = recording.tally
        self.tally.check(names[0])


def images(n, **changes):
    """Messages of images."""
    made = [
        Sent(
            np.arange(12).reshape(3, 4) + k,
            "palm",
            BEGIN_NS + k * PERIOD_NS,
            BEGIN_NS + k,
        )
        for k in range(n)
    ]
    return [replace(one, **changes) for one in made]


@any_folder
@given(
    data=st.data(),
    grid=grids(),
    storage=st.sampled_from(STORAGES),
    mode=st.sampled_from(("", "chunk", "file", "message")),
)
def test_a_drawn_bag_is_read_back_and_each_message_is_accounted_for(
    tmp_path, data, grid, storage, mode
):
    sent = frames_sent(data.draw, grid)
    path = write_bag(tmp_path, storage, mode, grid, sent)
    kept = [one for one in sent if one.frame is not None]
    if not kept:
        assert "/tactile: holds no" in refusal(lambda: Read(path, grid.layout))
        return
    read = Read(path, grid.layout)
    assert np.array_equal(read.frames, [one.frame for one in kept])
    has_stamps = grid.kind != "array"
    assert read.times == [one.stamp_ns if has_stamps else one.log_ns for one in kept]
    n_empty = len(sent) - len(kept)
    assert read.tally.n_frames == len(kept)
    assert read.tally.dropped == ({"empty messages": n_empty} if n_empty else {})
    assert read.notes[0] == "topic /tactile"


@any_folder
@given(data=st.data(), grid=grids(), storage=st.sampled_from(STORAGES))
def test_of_a_bag_that_is_cut_off_all_before_the_cut_is_read(
    tmp_path, data, grid, storage
):
    sent = [one for one in frames_sent(data.draw, grid, 40) if one.frame is not None]
    path = write_bag(tmp_path, storage, "", grid, sent)
    (file,) = files_of(path)
    whole = file.read_bytes()
    n_bytes = data.draw(st.integers(1, len(whole)))
    file.write_bytes(whole[:n_bytes])
    reads = []
    if refusal(lambda: reads.append(Read(path, grid.layout)), SourceError):
        return
    (read,) = reads
    frames = [one.frame for one in sent]
    assert np.array_equal(read.frames, frames[: len(read.frames)])
    n_missing = len(frames) - len(read.frames)
    if storage == "bag":
        is_named = any("lost" in name for name in read.tally.dropped)
        assert is_named or any("killed" in note for note in read.notes) or not n_missing
    else:
        # metadata.yaml is beside it.
        assert read.tally.n_items == len(frames)
        assert sum(read.tally.dropped.values()) == n_missing


@pytest.mark.parametrize("storage", STORAGES)
def test_a_long_bag_that_is_cut_off_loses_its_end_alone(tmp_path, storage):
    path = write_bag(tmp_path, storage, "", IMAGES, images(2000))
    (file,) = files_of(path)
    whole = file.read_bytes()
    # The first two thirds of a file hold the tables, and most messages.
    file.write_bytes(whole[: 2 * len(whole) // 3])
    (tmp_path / "bag" / "metadata.yaml").unlink(missing_ok=True)
    read = Read(path)
    assert len(read.frames) > 200
    assert any("or more lost behind" in name for name in read.tally.dropped)


def killed(path, n_in_log):
    """The database of a recorder that was killed: the last messages are in its log alone."""
    (file,) = files_of(path)
    copy = file.with_suffix(".copy")
    with closing(sqlite3.connect(file)) as base:
        base.execute("PRAGMA journal_mode = WAL")
        base.execute("PRAGMA wal_autocheckpoint = 0")
        query = "SELECT id, topic_id, timestamp, data FROM messages ORDER BY id DESC LIMIT ?"
        rows = base.execute(query, (n_in_log,)).fetchall()
        base.execute("DELETE FROM messages WHERE id >= ?", (rows[-1][0],))
        base.commit()
        base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        base.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows[::-1])
        base.commit()
        # Closed, it would write its log into the file.
        copy.write_bytes(file.read_bytes())
        log = Path(f"{file}-wal").read_bytes()
    copy.rename(file)
    Path(f"{file}-wal").write_bytes(log)
    return file


@any_folder
@given(n=st.integers(2, 30), data=st.data())
def test_messages_in_the_log_of_a_killed_recorder_are_read(tmp_path, n, data):
    n_in_log = data.draw(st.integers(1, n - 1))
    path = write_bag(tmp_path, "db3", "", IMAGES, images(n))
    file = killed(path, n_in_log)
    before = {one.name: one.read_bytes() for one in path.iterdir()}
    read = Read(path)
    assert np.array_equal(read.frames, [one.frame for one in images(n)])
    assert "its recorder was killed: what it wrote is read" in read.notes
    assert {one.name: one.read_bytes() for one in path.iterdir()} == before

    # Without its log, what is missing is named by its number.
    Path(f"{file}-wal").unlink()
    rest = Read(path)
    assert len(rest.frames) == n - n_in_log
    name = f"missing of the {n} that metadata.yaml states"
    assert rest.tally.dropped == {name: n_in_log}


@any_folder
@given(data=st.data(), grid=grids(), storage=st.sampled_from(STORAGES))
def test_two_frames_on_one_topic_are_never_one_skin(tmp_path, data, grid, storage):
    if grid.kind == "array":
        return  # has no header
    left = frames_sent(data.draw, grid)
    right = frames_sent(data.draw, grid)
    path = write_bag(tmp_path, storage, "", grid, interleaved(left, right, "back"))
    frames = {
        "palm": [one.frame for one in left if one.frame is not None],
        "back": [one.frame for one in right if one.frame is not None],
    }
    if all(frames.values()):
        with pytest.raises(UnstatedError, match="messages of 2 frames") as refused:
            Read(path, grid.layout)
        options = [option["frame_id"] for option in refused.value.options]
        assert sorted(options) == ["back", "palm"]
    for frame_id, expected in frames.items():
        if expected:
            read = Read(path, replace(grid.layout, frame_id=frame_id))
            assert np.array_equal(read.frames, expected)
            assert sum(read.tally.dropped.values()) == len(left) + len(right) - len(
                expected
            )


@pytest.mark.parametrize("storage", STORAGES)
def test_a_sensor_reads_a_bag(tmp_path, storage):
    source = open_file(write_bag(tmp_path, storage, "", IMAGES, images(3)))
    np.testing.assert_array_equal(source.frames, [one.frame for one in images(3)])
    assert source.skin.unit == "counts"
    assert source.rate_hz == 50.0
    assert source.stamp_ns.tolist() == [0, PERIOD_NS, 2 * PERIOD_NS]


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_the_files_of_a_bag_of_ros_2_follow_each_other(tmp_path, kind):
    sent = images(4)
    names = []
    for k, name in enumerate(("bag_9", "bag_10")):
        (tmp_path / name).mkdir()
        path = write_bag(tmp_path / name, kind, "", IMAGES, sent[2 * k : 2 * k + 2])
        names.append(str(files_of(path)[0].rename(tmp_path / f"{name}.{kind}")))
    assert np.array_equal(Read(names).frames, [one.frame for one in sent])
    # By the times at which they were recorded, in either order.
    assert np.array_equal(Read(names[::-1]).frames, [one.frame for one in sent])
    (tmp_path / "metadata.yaml").touch()
    for name in ("bag_9", "bag_10"):
        (tmp_path / name / "bag" / "metadata.yaml").unlink()
        (tmp_path / name / "bag").rmdir()
        (tmp_path / name).rmdir()
    np.testing.assert_array_equal(
        open_file(tmp_path).frames, [one.frame for one in sent]
    )


def test_stamps_that_fall_are_never_used_without_a_word(tmp_path):
    sent = images(4)
    # Of a clock that was set.
    sent[2] = replace(sent[2], stamp_ns=sent[0].stamp_ns - 10**9)
    path = write_bag(tmp_path, "mcap", "", IMAGES, sent)
    with pytest.raises(
        UnstatedError, match="message 3: its stamp is before"
    ) as refused:
        Read(path)
    assert refused.value.options == ({"time": "log"},)
    assert Read(path, replace(EMPTY, time="log")).times == [one.log_ns for one in sent]
    with pytest.raises(SourceError, match=r"; add time=log$"):
        open_file(path)


def test_of_messages_that_were_overtaken_no_order_is_proposed(tmp_path):
    sent = images(4)
    sent[2] = replace(sent[2], stamp_ns=sent[0].stamp_ns)
    path = write_bag(tmp_path, "mcap", "", IMAGES, sent)
    with pytest.raises(SourceError, match=r"times of the recording and order$"):
        open_file(path)


def test_headers_without_stamps_have_the_times_of_the_recording(tmp_path):
    read = Read(write_bag(tmp_path, "db3", "", IMAGES, images(3, stamp_ns=0)))
    assert read.times == [BEGIN_NS, BEGIN_NS + 1, BEGIN_NS + 2]
    assert "its headers have no stamps: times of the recording" in read.notes


def test_messages_are_sorted_by_the_times_at_which_they_were_recorded(tmp_path):
    sent = images(6, stamp_ns=0)
    shuffled = [sent[k] for k in (1, 0, 3, 2, 5, 4)]
    for storage in ("db3", "mcap"):
        read = Read(write_bag(tmp_path, storage, "", IMAGES, shuffled))
        assert np.array_equal(read.frames, [one.frame for one in sent])
    far = [*images(WINDOW + 2, stamp_ns=0)[1:], sent[0]]
    with pytest.raises(
        SourceError, match="was recorded before more than 1024 messages"
    ):
        Read(write_bag(tmp_path, "mcap", "", IMAGES, far))
    assert list(in_order(iter(()))) == []


def test_a_change_of_shape_is_refused_or_left_out_by_name(tmp_path):
    sent = images(4)
    sent[2] = replace(sent[2], frame=np.zeros((2, 2), int))
    path = write_bag(tmp_path, "mcap", "", IMAGES, sent)
    with pytest.raises(SourceError, match=r"changes: \(3 x 4\), then \(2 x 2\)"):
        Read(path)
    read = Read(path, replace(EMPTY, n_rows=3, n_cols=4))
    assert len(read.frames) == 3
    assert read.tally.dropped == {"messages of another shape": 1}
    assert Read(path, replace(EMPTY, skip=3)).tally.dropped == {"skipped": 3}


def write_topics(folder, storage, grids_of):
    """A bag of several topics."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    path = folder / "topics"
    store = stream_store(2)
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
        for topic, grid in grids_of.items():
            if grid is None:
                kind = "sensor_msgs/msg/JointState"
                header = store.types["std_msgs/msg/Header"](
                    store.types["builtin_interfaces/msg/Time"](1, 2), "arm"
                )
                body = store.types[kind](header, ["a"], *[np.arange(2.0)] * 3)
            else:
                kind, body = message_of(store, 2, grid, images(1)[0])
            connection = writer.add_connection(topic, kind, typestore=store)
            writer.write(connection, BEGIN_NS, store.serialize_cdr(body, kind))
    return path


@pytest.mark.parametrize("storage", ["db3", "mcap"])
def test_of_several_topics_none_is_chosen(tmp_path, storage):
    topics = {
        "/joints": None,
        "/left": IMAGES,
        "/right": Grid("stream", 3, 4, "<i4", 3),
    }
    path = write_topics(tmp_path, storage, topics)
    with pytest.raises(
        UnstatedError, match=r"2 topics of frames.*/left Image .3 x 4"
    ) as refused:
        Read(path)
    ways = [{"topic": "/left"}, {"topic": "/right", "field": "modules[0].taxels[].z"}]
    assert list(refused.value.options) == ways
    frame = images(1)[0].frame
    for way in ways:
        read = Read(path, EMPTY.stating({"n_rows": 3, "n_cols": 4, **way}))
        assert np.array_equal(read.frames, [frame])
    read = Read(
        path, EMPTY.stating({"n_rows": 3, "n_cols": 4, **ways[1], "channel": ""})
    )
    assert len(read.frames) == 1
    with pytest.raises(SourceError, match="no topic '/off'; allowed: "):
        Read(path, replace(EMPTY, topic="/off"))
    joints = replace(EMPTY, topic="/joints", field="position", n_rows=1, n_cols=2)
    assert np.array_equal(Read(path, joints).frames, [[[0, 1]]])
    with pytest.raises(UnstatedError, match=r"position\[\]") as refused:
        Read(path, replace(EMPTY, topic="/joints"))
    assert {"field": "effort[]"} in refused.value.options


def test_a_file_of_no_frames_says_what_it_holds(tmp_path):
    none = Grid("image", 3, 4, "<u2", 2)
    path = write_bag(tmp_path, "db3", "", none, images(2, frame=np.zeros((0, 0))))
    assert "/tactile: holds no number" in refusal(lambda: Read(path))
    with closing(sqlite3.connect(tmp_path / "a.db3")) as base:
        base.execute("CREATE VIEW topics AS SELECT 1")
        base.execute("CREATE VIEW messages AS SELECT 1")
    with pytest.raises(SourceError, match="holds no tables topics and messages"):
        Read([str(tmp_path / "a.db3")])
    assert set(ARRAYS) <= cdr.types(1).types.keys() & cdr.types(2).types.keys()


def test_what_cannot_be_decompressed_says_what_would(tmp_path):
    path = write_bag(tmp_path, "db3", "message", IMAGES, images(2))
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("zstd", "lz9"))
    with pytest.raises(SourceError, match="compressed: ros2 bag convert"):
        Read(path)
    plain = tmp_path / "a.db3.zstd"
    plain.write_bytes(b"\x28\xb5\x2f\xfd" + bytes(20))
    with pytest.raises(SourceError, match="compressed: ros2 bag convert"):
        Read([str(plain)])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Bytes of a recording of each kind."""
    found = {}
    for kind in STORAGES:
        path = write_bag(tmp_path_factory.mktemp(kind), kind, "", IMAGES, images(3))
        found[kind] = files_of(path)[0].read_bytes()
    return found


@any_folder
@given(data=st.data(), kind=st.sampled_from(STORAGES))
def test_random_and_mutated_recordings_are_read_or_refused_in_one_line(
    tmp_path, whole, data, kind
):
    path = tmp_path / f"any.{kind}"
    read = []
    path.write_bytes(mutated(data, whole[kind]))
    refusal(lambda: read.append(Read(path)), SourceError)
    assert all(frame.shape == (3, 4) for one in read for frame in one.frames)


LABELLED = "maker_msgs/msg/Labelled"
LABELLED_TEXT = """uint32 time_ms
uint8 id
uint8[] ids
float32[] values
"""


def labelled_bag(path, messages):
    """A bag of messages (time_ms, id, ids, values)."""
    store = registered(store_of(2), LABELLED, LABELLED_TEXT)
    shutil.rmtree(path, ignore_errors=True)
    with rosbag2.Writer(path, version=9) as writer:
        connection = writer.add_connection(TOPIC, LABELLED, typestore=store)
        for k, (time_ms, skin, ids, values) in enumerate(messages):
            body = store.types[LABELLED](
                time_ms, skin, np.array(ids, "u1"), np.array(values, "f4")
            )
            writer.write(
                connection,
                BEGIN_NS + k * PERIOD_NS,
                store.serialize_cdr(body, LABELLED),
            )
    return path


@any_folder
@given(order=st.permutations(range(6)), n_skins=st.integers(1, 3))
def test_members_of_messages_say_time_skin_and_order(tmp_path, order, n_skins):
    values = np.arange(6.0)
    messages = [
        (70 * k, k % n_skins, order, values[list(order)] + 10 * k)
        for k in range(4 * n_skins)
    ]
    path = labelled_bag(tmp_path / "bag", messages)
    layout = Layout(n_rows=2, n_cols=3, field="values[]")
    if n_skins > 1:
        with pytest.raises(SourceError, match="state frame_id"):
            open_file(path, layout)
    for skin in range(n_skins):
        source = open_file(path, layout.stating({"frame_id": str(skin)}))
        numbers = np.arange(skin, 4 * n_skins, n_skins)
        expected = values + 10 * numbers[:, np.newaxis]
        np.testing.assert_array_equal(source.frames, expected.reshape(-1, 2, 3))
        np.testing.assert_allclose(
            source.stamp_ns / 1e9, 0.07 * (numbers - skin), atol=1e-9
        )


def test_taxels_that_change_places_are_refused(tmp_path):
    messages = [(0, 0, [0, 1, 2, 3], range(4)), (70, 0, [1, 0, 2, 3], range(4))]
    path = labelled_bag(tmp_path / "bag", messages)
    with pytest.raises(SourceError, match="the order of its taxels changes"):
        open_file(path, Layout(n_rows=2, n_cols=2, field="values[]"))
