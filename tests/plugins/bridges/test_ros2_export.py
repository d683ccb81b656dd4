"""Export of bags to ROS 2: its readers find every number."""

from __future__ import annotations

import builtins
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import LAG_NS, MASK, Bag, frame, frames, make_bag, of_kind, run_bag

from sparseskin.messages import Measurements, Reconstruction, Taxels, Truth
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.recorder.bag.format import BagError

N_FRAMES = 40


@pytest.fixture
def bag(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Bag:
    """Runs `sparseskin bag ARGUMENTS` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return run_bag


def test_an_export_overwrites_nothing(bag: Bag) -> None:
    make_bag(Path("a.mcap"), frames(1))
    Path("taken").write_bytes(b"precious")
    with pytest.raises(SparseskinError, match="taken: exists already"):
        bag("export", "a.mcap", "--to", "ros2", "--out", "taken")
    assert Path("taken").read_bytes() == b"precious"


def test_rosbags_reads_the_same_numbers_from_a_ros2_export(bag: Bag) -> None:
    pytest.importorskip("mcap_ros2", reason="the extra ros2 is not installed")
    rosbags = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed")
    typesys = pytest.importorskip("rosbags.typesys")
    messages = frames(N_FRAMES)
    make_bag(Path("a.mcap"), messages)
    assert bag("export", "a.mcap", "--to", "ros2") == 0
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    images: dict[str, list[Any]] = {}
    scalars: dict[str, list[float]] = {}
    states: dict[str, Any] = {}
    with rosbags.Reader(Path("a_ros2")) as reader:
        assert {connection.msgtype for connection in reader.connections} == {
            "sensor_msgs/msg/Image",
            "std_msgs/msg/Float32",
            "std_msgs/msg/String",
        }
        for connection, _, raw in reader.messages():
            message = store.deserialize_cdr(raw, connection.msgtype)
            if connection.msgtype == "std_msgs/msg/Float32":
                scalars.setdefault(connection.topic, []).append(message.data)
                continue
            if connection.msgtype == "std_msgs/msg/String":
                states[connection.topic] = json.loads(message.data)
                continue
            stamp = message.header.stamp
            array = message.data.view("<f4").reshape(message.height, message.width)
            assert (message.encoding, message.step) == ("32FC1", 4 * message.width)
            assert message.header.frame_id == "skin"
            images.setdefault(connection.topic, []).append(
                (stamp.sec * 10**9 + stamp.nanosec, array)
            )
    assert images.keys() == {
        f"/skin/{name}" for name in ("taxels", "truth", "measurements", "reconstruction")
    }
    for cls in (Taxels, Truth, Reconstruction):
        topic, sent = f"/skin/{cls.schema}", of_kind(messages, cls)
        for message, (stamp_ns, array) in zip(sent, images[topic], strict=True):
            assert stamp_ns == message.stamp_ns
            assert np.array_equal(array, message.forces)
        sums = [np.float32(message.forces.sum(dtype=np.float64)) for message in sent]
        assert scalars[f"{topic}/total_force"] == sums
    for message, (_, array) in zip(
        of_kind(messages, Measurements), images["/skin/measurements"], strict=True
    ):
        assert np.array_equal(array[0], message.y)
    residuals = [np.float32(message.residual) for message in of_kind(messages, Reconstruction)]
    assert scalars["/skin/reconstruction/residual"] == residuals
    assert len(scalars) == 4
    assert states.keys() == {"/skin/skin"}
    mask = [[cell == "1" for cell in row] for row in states["/skin/skin"]["mask"]]
    assert np.array_equal(mask, MASK)


def test_a_ros2_export_holds_estimated_errors_where_there_are_some(bag: Bag) -> None:
    pytest.importorskip("mcap_ros2", reason="the extra ros2 is not installed")
    rosbags = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed")
    typesys = pytest.importorskip("rosbags.typesys")
    stated: list[tuple[float | None, bool]] = [(0.5, False), (None, True), (0.25, True)]
    messages = [
        replace(frame(k)[-1], error=error, trusted=trusted)
        for k, (error, trusted) in enumerate(stated)
    ]
    make_bag(Path("a.mcap"), messages)
    assert bag("export", "a.mcap", "--to", "ros2") == 0
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    found: dict[str, list[tuple[int, Any]]] = {"error": [], "trusted": []}
    with rosbags.Reader(Path("a_ros2")) as reader:
        for connection, stamp_ns, raw in reader.messages():
            name = connection.topic.rpartition("/")[2]
            if name in found:
                data = store.deserialize_cdr(raw, connection.msgtype).data
                found[name].append((stamp_ns, data))
    stamps = [messages[k].stamp_ns + LAG_NS for k in (0, 2)]
    assert found == {
        "error": list(zip(stamps, (0.5, 0.25), strict=True)),
        "trusted": list(zip(stamps, (False, True), strict=True)),
    }


def test_without_the_extra_the_ros2_export_names_the_command_that_installs_it(
    bag: Bag, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_bag(Path("a.mcap"), frames(1))
    real_import = builtins.__import__

    def no_mcap_ros2(name: str, *arguments: Any, **options: Any) -> Any:
        if name.startswith("mcap_ros2"):
            raise ModuleNotFoundError(name)
        return real_import(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", no_mcap_ros2)
    with pytest.raises(BagError, match=r'pip install "sparseskin\[ros2\]"'):
        bag("export", "a.mcap", "--to", "ros2")
    assert [path.name for path in Path().iterdir()] == ["a.mcap"]


def test_a_stamp_beyond_ros_is_refused(bag: Bag) -> None:
    pytest.importorskip("mcap_ros2", reason="the extra ros2 is not installed")
    late = Taxels(stamp_ns=(1 << 31) * 10**9, patch="skin", forces=np.zeros((2, 2), np.float32))
    make_bag(Path("a.mcap"), [late])
    with pytest.raises(BagError, match="beyond what ROS 2 can hold"):
        bag("export", "a.mcap", "--to", "ros2")
    assert [path.name for path in Path().iterdir()] == ["a.mcap"]
