"""Exports of bags to Foxglove and ROS 2: readers that are not ours find every number."""

import io
import json

import numpy as np
import pytest
from bags import LAG_NS, MASK, N_COLS, N_ROWS, frame, make_bag
from exported import N_FRAMES, contacts, points_bag, rich_frames

from sparseskin.messages import Contacts, Measurements, Reconstruction, Taxels
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.plugins.bridges.exports.foxglove import export_foxglove, figures_of
from sparseskin.plugins.bridges.exports.ros2 import export_ros2


@pytest.fixture
def rich(tmp_path):
    make_bag(tmp_path / "a.mcap", rich_frames())
    return tmp_path / "a.mcap"


def images():
    """Topic, message and pixels of every frame of the bag."""
    for message in rich_frames():
        if isinstance(message, Measurements):
            yield message.topic, message, np.asarray(message.y)
        elif (forces := getattr(message, "forces", None)) is not None:
            yield message.topic, message, forces[0]
        if isinstance(message, Reconstruction) and message.sd is not None:
            yield f"{message.topic}/sd", message, message.sd[0]


def read_mcap(path, decoders):
    """Log time, schema, content of each message by topic, by the official reader and a decoder."""
    reader = pytest.importorskip("mcap.reader")
    factory = pytest.importorskip(
        f"{decoders}.decoder", reason="not installed"
    ).DecoderFactory()
    found = {}
    for schema, channel, message in reader.make_reader(
        io.BytesIO(path.read_bytes())
    ).iter_messages():
        if channel.message_encoding == "json":
            content = json.loads(message.data)
        else:
            content = factory.decoder_for(channel.message_encoding, schema)(
                message.data
            )
        found.setdefault(channel.topic, []).append(
            (message.log_time, schema.name, content)
        )
    return found


@pytest.fixture
def foxglove(rich):
    pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
    with BagReader(rich) as bag:
        (path,) = export_foxglove(bag, rich.with_name("a_foxglove.mcap"))
    return read_mcap(path, "mcap_protobuf")


def stamp_of(message):
    return int(message.timestamp.seconds * 10**9 + message.timestamp.nanos)


def test_every_pixel_and_stamp_is_in_a_foxglove_export(foxglove):
    for topic, message, array in images():
        log_ns, schema, image = foxglove[topic].pop(0)
        assert schema == "foxglove.RawImage"
        assert image.encoding == "32FC1"
        assert image.frame_id == "skin"
        assert stamp_of(image) == message.stamp_ns
        assert log_ns == message.stamp_ns + LAG_NS
        assert (image.height, image.width, image.step) == (
            *array.shape,
            4 * array.shape[1],
        )
        assert np.array_equal(
            np.frombuffer(image.data, "<f4").reshape(array.shape), array
        )
    left = [
        topic
        for topic, held in foxglove.items()
        if held and held[0][1].endswith("RawImage")
    ]
    assert left == []


def test_the_grids_of_a_foxglove_export_have_cells_pose_and_layers(foxglove):
    sent = [m for m in rich_frames() if isinstance(m, Reconstruction)]
    for (_, schema, grid), message in zip(
        foxglove["/skin/reconstruction/grid"], sent, strict=True
    ):
        assert schema == "foxglove.Grid"
        assert grid.frame_id == "skin"
        assert stamp_of(grid) == message.stamp_ns
        assert grid.cell_size.x == 0.005
        assert grid.cell_size.y == 0.005
        corner = (grid.pose.position.x, grid.pose.position.y)
        assert corner == pytest.approx((-0.0025 * N_COLS, -0.0025 * N_ROWS))
        maps = {"force": message.forces[0]} | (
            {} if message.sd is None else {"sd": message.sd[0]}
        )
        assert [field.name for field in grid.fields] == list(maps)
        cells = np.frombuffer(grid.data, np.uint8).reshape(
            N_ROWS, N_COLS, grid.cell_stride
        )
        for field, array in zip(grid.fields, maps.values(), strict=True):
            values = (
                cells[:, :, field.offset : field.offset + 4].copy().view("<f4")[:, :, 0]
            )
            assert np.array_equal(values, array)


def test_figures_and_states_of_a_foxglove_export_are_those_of_the_messages(foxglove):
    for message in rich_frames():
        if isinstance(message, Reconstruction):
            _, schema, figures = foxglove[f"{message.topic}/figures"].pop(0)
            assert schema == "sparseskin.Figures"
            assert figures == figures_of(message)
            assert {"iterations", "residual", "solve_ns", "trusted"} < figures.keys()
    (_, _, phi) = foxglove["/skin/phi"][0]
    (_, _, skin) = foxglove["/skin/skin"][0]
    assert phi["kind"] == "sbhe"
    assert phi["n"] == 34
    assert phi["seed"] == 7
    assert phi["rows"] == "fixed"
    assert np.array_equal([[cell == "1" for cell in row] for row in skin["mask"]], MASK)


def test_a_foxglove_export_has_the_contacts_as_numbers_and_as_a_scene(foxglove):
    for k in range(N_FRAMES):
        sent = contacts(k)
        (_, schema, held), (_, _, scene) = (
            foxglove[f"/skin/contacts{ending}"][k] for ending in ("", "/scene")
        )
        assert schema == "sparseskin.Contacts"
        assert held["n"] == k % 3
        assert held["trusted"] == (k != 4)
        assert [one["total"] for one in held["contacts"]] == sent.total.tolist()
        assert all(("x_mm" in one) == (k % 3 == 1) for one in held["contacts"])
        assert held["events"] == [{"id": n, "event": "begin"} for n in sent.id]
        # all: the scene is replaced
        assert [one.type for one in scene.deletions] == [1]
        assert [one.id for one in scene.entities] == [str(n) for n in sent.id]
        for n, entity in enumerate(scene.entities):
            (sphere,) = entity.spheres
            (arrow,) = entity.arrows
            (text,) = entity.texts
            if k % 3 == 1:  # its place is known, in mm; the frame is that of the middle
                corner = (
                    0.001 - 0.005 * (N_COLS - 1) / 2,
                    0.001 - 0.005 * (N_ROWS - 1) / 2,
                )
                at = sphere.pose.position
                assert (at.x, at.y, at.z) == pytest.approx((*corner, 0.001))
            length = arrow.shaft_length + arrow.head_length
            assert arrow.pose.position.z - sphere.pose.position.z == pytest.approx(
                length
            )
            assert length == pytest.approx(sent.total[n] * 0.005 * N_COLS / (10 * 2.5))
            turn = arrow.pose.orientation  # of x into -z: a quarter about y
            assert (turn.x, turn.y, turn.z, turn.w) == pytest.approx(
                (0, 0.5**0.5, 0, 0.5**0.5)
            )
            assert text.text == f"{n + 1}: {0.5 + k:.3g} N"


def test_a_point_cloud_of_foxglove_has_normals_and_the_rows_of_the_points_file(
    tmp_path,
):
    pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
    path = tmp_path / "a.mcap"
    state = points_bag(path)
    with BagReader(path) as bag:
        (made,) = export_foxglove(bag, path.with_name("a_foxglove.mcap"))
    _, _, cloud = read_mcap(made, "mcap_protobuf")["/skin/taxels/points"][0]
    names = [field.name for field in cloud.fields]
    assert names == ["x", "y", "z", "force", "nx", "ny", "nz", "row"]
    table = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)
    (sent,) = (m for m in frame(0) if isinstance(m, Taxels))
    assert np.array_equal(table[:, 3], sent.forces[0][MASK])
    assert np.array_equal(table[:, [0, 1, 2, 4, 5, 6]], state.points)
    assert np.array_equal(table[:, 7].copy().view("<u4"), state.point_rows)


def test_every_number_is_in_a_ros2_export_and_its_folder_is_a_bag(rich):
    rosbags = pytest.importorskip(
        "rosbags.rosbag2", reason="the extra ros2 is not installed"
    )
    with BagReader(rich) as bag:
        mcap, _ = export_ros2(bag, rich.with_name("a_ros2"))
    held = read_mcap(mcap, "mcap_ros2")
    with rosbags.Reader(mcap.parent) as reader:
        assert {one.topic: one.msgcount for one in reader.connections} == {
            topic: len(messages) for topic, messages in held.items()
        }
    for topic, message, array in images():
        log_ns, schema, image = held[topic].pop(0)
        assert schema == "sensor_msgs/msg/Image"
        assert image.encoding == "32FC1"
        stamp = image.header.stamp
        assert image.header.frame_id == "skin"
        assert stamp.sec * 10**9 + stamp.nanosec == message.stamp_ns
        assert log_ns == message.stamp_ns + LAG_NS
        assert (image.height, image.width, image.step) == (
            *array.shape,
            4 * array.shape[1],
        )
        assert np.array_equal(np.frombuffer(bytes(image.data), "<f4"), array.ravel())
    for message in rich_frames():
        expected = {}
        if (forces := getattr(message, "forces", None)) is not None:
            expected["total_force"] = np.float32(forces.sum(dtype=np.float64))
        if isinstance(message, Reconstruction):
            expected["residual"] = np.float32(message.residual[0])
            if message.error[0] is not None:
                expected |= {"error": message.error[0], "trusted": message.trusted[0]}
        for name, value in expected.items():
            assert held[f"{message.topic}/{name}"].pop(0)[2].data == value
        if isinstance(message, Contacts):
            check_contacts(message, {kind: held[f"{message.topic}/{kind}"].pop(0) for kind in
                                     ("wrench", "markers", "array")})  # fmt: skip
    states = {
        name: json.loads(held[f"/skin/{name}"].pop(0)[2].data)
        for name in ("skin", "phi")
    }
    assert states["phi"]["seed"] == 7
    assert np.array_equal(
        [[cell == "1" for cell in row] for row in states["skin"]["mask"]], MASK
    )


def check_contacts(sent, held):
    kinds = {name: schema for name, (_, schema, _) in held.items()}
    assert kinds["wrench"] == "geometry_msgs/msg/WrenchStamped"
    assert kinds["markers"] == "visualization_msgs/msg/MarkerArray"
    wrench, markers, table = (held[name][2] for name in ("wrench", "markers", "array"))
    stamp = wrench.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == sent.stamp_ns
    assert wrench.wrench.force.z == pytest.approx(-sent.total.sum())
    everything, *others = markers.markers
    assert everything.action == 3
    assert everything.ns == ""
    assert [(m.ns, m.id, m.type, m.action) for m in others] == [
        (*kind, 0)
        for n in sent.id
        for kind in (("sphere", n, 2), ("arrow", n, 0), ("text", n, 9))
    ]
    for n, (_, arrow, text) in enumerate(zip(*[iter(others)] * 3, strict=True)):
        tail, tip = arrow.points
        assert tail.x == tip.x
        assert tail.y == tip.y
        assert tail.z - tip.z == pytest.approx(
            sent.total[n] * 0.005 * N_COLS / (10 * 2.5)
        )
        assert text.text.startswith(f"{sent.id[n]}: ")
    names = table.layout.dim[1].label.split(",")
    rows = np.array(table.data).reshape(table.layout.dim[0].size, len(names))
    for name, values in (
        ("id", sent.id),
        ("total", sent.total),
        ("row", sent.centre[:, 0]),
    ):
        assert np.array_equal(rows[:, names.index(name)], values)


def test_a_stamp_beyond_ros_is_refused(tmp_path):
    pytest.importorskip("rosbags", reason="the extra ros2 is not installed")
    late = Taxels(
        stamp_ns=(1 << 31) * 10**9, patch="skin", forces=np.zeros((2, 2), np.float32)
    )
    make_bag(tmp_path / "a.mcap", [late])
    with (
        BagReader(tmp_path / "a.mcap") as bag,
        pytest.raises(BagError, match="beyond what ROS 2"),
    ):
        export_ros2(bag, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
