"""Recordings of ROS 1 and ROS 2, written by rosbags, as files of readings."""

import sqlite3

import numpy as np
import pytest
from damaged import mutated, refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("rosbags", reason="rosbags is not installed")
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.enums import StoragePlugin

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.files.recording import Policy
from sparseskin.plugins.bridges import cdr
from sparseskin.plugins.bridges.frames import ARRAYS

COUNTS = np.arange(24).reshape(2, 3, 4)
BEGIN_NS, PERIOD_NS = 1_790_000_000_000_000_000, 20_000_000
ANY = Policy("zero", "zero")
UINTS = "std_msgs/msg/UInt16MultiArray"


def messages(ros, frame, stamp_ns):
    """A message on each topic."""
    made = cdr.types(ros).types
    time = made["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    header = made["std_msgs/msg/Header"](
        **({"seq": 1} if ros == 1 else {}), stamp=time, frame_id="skin"
    )
    field = made["sensor_msgs/msg/PointField"]
    cells = np.zeros(12, [("x", "<f4"), ("force", "<u2")])
    cells["force"] = frame.ravel()
    layout = made["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    image = made[cdr.IMAGE](
        header,
        3,
        4,
        "16UC1",
        1,
        10,
        np.insert(frame, 4, 7, axis=1).astype(">u2").view("u1").ravel(),
    )
    cloud = made[cdr.CLOUD](
        header, 1, 12, [field("x", 0, 7, 1), field("force", 4, 4, 1)], False, 6, 72,
        cells.view("u1"), True,
    )  # fmt: skip
    flat = made[UINTS](layout, frame.astype("u2").ravel())
    other = made["std_msgs/msg/Header"](**vars(header))
    kinds = (cdr.IMAGE, cdr.CLOUD, UINTS, "std_msgs/msg/Header")
    return dict(
        zip(
            ("/image", "/cloud", "/flat", "/other"),
            zip(kinds, (image, cloud, flat, other), strict=True),
            strict=True,
        )
    )


def write(folder, kind, topics, begin_ns=BEGIN_NS):
    """A recording of some topics, as a file or the folder of a bag of ROS 2."""
    ros = 1 if kind == "bag" else 2
    store = cdr.types(ros)
    path = folder / ("a.bag" if ros == 1 else "bag")
    if ros == 1:
        writer = rosbag1.Writer(path)
        writer.set_compression(writer.CompressionFormat.BZ2)
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    encode = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    with writer:
        found = {}
        for k, frame in enumerate(COUNTS):
            for topic, (name, message) in messages(ros, frame, begin_ns + k * PERIOD_NS).items():
                if topic in topics:
                    if topic not in found:
                        found[topic] = writer.add_connection(topic, name, typestore=store)
                    writer.write(found[topic], begin_ns + k * PERIOD_NS, encode(message, name))
    return path


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_the_files_of_a_bag_of_ros_2_follow_each_other(tmp_path, kind):
    for k, name in enumerate(("bag_10", "bag_9")):
        (tmp_path / name).mkdir()
        begin_ns = BEGIN_NS + 2 * (1 - k) * PERIOD_NS
        (part,) = write(tmp_path / name, kind, ("/image",), begin_ns).glob(f"*.{kind}")
        part.rename(tmp_path / f"{name}.{kind}")
    (tmp_path / "metadata.yaml").touch()
    source = open_file(tmp_path)
    np.testing.assert_array_equal(source.frames, [*COUNTS, *COUNTS])
    assert source.stamp_ns == tuple(k * PERIOD_NS for k in range(4))


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_frames_of_each_kind_of_message_are_read(tmp_path, kind):
    path = write(tmp_path, kind, ("/image", "/cloud", "/flat", "/other"))
    (tmp_path / "flat").mkdir()
    for topic in ("/image", "/cloud", "/flat"):
        source = open_file(path, topic=topic, n_rows=3)
        np.testing.assert_array_equal(source.frames, COUNTS)
        assert (source.skin.unit, source.rate_hz, source.stamp_ns) == (
            "counts",
            50.0,
            (0, PERIOD_NS),
        )
    with pytest.raises(
        SourceError, match=r"holds 3 topics of frames: /image .Image, 3 x 4.*add topic=/image"
    ):
        open_file(path)
    with pytest.raises(SourceError, match=r"add topic=/cloud n_rows=3 n_cols=4$"):
        open_file(write(tmp_path / "flat", kind, ("/cloud", "/flat")))
    with pytest.raises(SourceError, match=r"no topic '/off'; allowed: /image"):
        open_file(path, topic="/off")
    with pytest.raises(SourceError, match=r"12 readings; .* shape .*; add n_rows=3 n_cols=4$"):
        open_file(path, topic="/flat")


def test_the_only_topic_of_frames_is_taken_and_none_is_named(tmp_path):
    assert open_file(write(tmp_path, "db3", ("/image", "/other"))).n_frames == 2
    (tmp_path / "none").mkdir()
    with pytest.raises(SourceError, match=r"no topic holds frames; it holds /other .std_msgs/msg"):
        open_file(write(tmp_path / "none", "mcap", ("/other",)))
    with sqlite3.connect(tmp_path / "a.db3") as base:
        base.execute("CREATE VIEW topics AS SELECT 1")
        base.execute("CREATE VIEW messages AS SELECT 1")
    with pytest.raises(SourceError, match="holds no tables topics and messages"):
        open_file(tmp_path / "a.db3")
    assert set(ARRAYS) <= cdr.types(1).types.keys() & cdr.types(2).types.keys()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Bytes of a recording of each kind."""
    found = {}
    for kind in ("bag", "db3", "mcap"):
        path = write(tmp_path_factory.mktemp(kind), kind, ("/image",))
        file = path if kind == "bag" else path / f"bag.{kind}"
        found[kind] = file.read_bytes()
    return found


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data(), kind=st.sampled_from(["bag", "db3", "mcap"]))
def test_random_and_mutated_recordings_are_read_or_refused_in_one_line(tmp_path, whole, data, kind):
    path, found = tmp_path / f"any.{kind}", []
    path.write_bytes(mutated(data, whole[kind]))
    refusal(lambda: found.append(open_file(path, policy=ANY)), SourceError)
    assert all(source.frames.shape[1:] == (3, 4) for source in found)
