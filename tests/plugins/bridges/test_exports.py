"""Exports of bags to Foxglove and ROS 2: their own readers find every number."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import LAG_NS, MASK, N_COLS, N_ROWS, M, frame, make_bag
from exported import N_FRAMES, points_bag, rich_frames

from sparseskin.messages import Measurements, Reconstruction, Resultant, Taxels
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.plugins.bridges.exports.foxglove import export_foxglove, figures_of


@pytest.fixture
def rich(tmp_path: Path) -> Path:
    make_bag(tmp_path / "a.mcap", rich_frames())
    return tmp_path / "a.mcap"


# --- foxglove --------------------------------------------------------------------------------


@pytest.fixture
def foxglove_file(rich: Path) -> Path:
    pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
    with BagReader(rich) as bag:
        (path,) = export_foxglove(bag, rich.with_name("a_foxglove.mcap"))
    return path


def decoded_protobuf(path: Path) -> dict[str, list[tuple[int, str, Any]]]:
    """Log time, schema and content of all messages; protobuf by the schemas in the file."""
    reader = pytest.importorskip("mcap.reader")
    factory = pytest.importorskip(
        "mcap_protobuf.decoder", reason="mcap-protobuf-support is not installed"
    ).DecoderFactory()
    found: dict[str, list[tuple[int, str, Any]]] = {}
    for schema, channel, message in reader.make_reader(
        io.BytesIO(path.read_bytes())
    ).iter_messages():
        if channel.message_encoding == "json":
            content = json.loads(message.data)
        else:
            content = factory.decoder_for(channel.message_encoding, schema)(message.data)
        found.setdefault(channel.topic, []).append((message.log_time, schema.name, content))
    return found


def stamp_of(message: Any) -> int:
    return message.timestamp.seconds * 10**9 + message.timestamp.nanos


def test_another_reader_finds_every_pixel_and_stamp_of_a_foxglove_export(
    foxglove_file: Path,
) -> None:
    held = decoded_protobuf(foxglove_file)
    for message in rich_frames():
        images: dict[str, Any] = {}
        if isinstance(message, Measurements):
            images = {message.topic: np.atleast_2d(np.asarray(message.y))}
        elif (forces := getattr(message, "forces", None)) is not None:
            images = {message.topic: forces}
            if getattr(message, "sd", None) is not None:
                images[f"{message.topic}/sd"] = getattr(message, "sd")  # noqa: B009
        for topic, array in images.items():
            log_ns, schema, image = held[topic].pop(0)
            assert (schema, image.encoding, image.frame_id) == (
                "foxglove.RawImage",
                "32FC1",
                "skin",
            )
            assert (stamp_of(image), log_ns) == (message.stamp_ns, message.stamp_ns + LAG_NS)
            assert (image.height, image.width, image.step) == (*array.shape, 4 * array.shape[1])
            assert np.array_equal(np.frombuffer(image.data, "<f4").reshape(array.shape), array)
    images_left = [
        topic for topic, left in held.items() if left and left[0][1].endswith("RawImage")
    ]
    assert images_left == []


def test_the_grids_of_a_foxglove_export_have_cells_pose_and_layers(foxglove_file: Path) -> None:
    grids = decoded_protobuf(foxglove_file)["/skin/reconstruction/grid"]
    sent = [m for m in rich_frames() if isinstance(m, Reconstruction)]
    for (_, schema, grid), message in zip(grids, sent, strict=True):
        assert (schema, grid.frame_id, stamp_of(grid)) == (
            "foxglove.Grid",
            "skin",
            message.stamp_ns,
        )
        assert (grid.cell_size.x, grid.cell_size.y) == (0.005, 0.005)
        corner = (grid.pose.position.x, grid.pose.position.y)
        assert corner == pytest.approx((-0.0025 * N_COLS, -0.0025 * N_ROWS))
        layers = {"force": message.forces} | ({} if message.sd is None else {"sd": message.sd})
        assert [field.name for field in grid.fields] == list(layers)
        rows = np.frombuffer(grid.data, np.uint8).reshape(N_ROWS, grid.row_stride)
        for field, array in zip(grid.fields, layers.values(), strict=True):
            cells = rows.reshape(N_ROWS, grid.column_count, grid.cell_stride)
            values = cells[:, :, field.offset : field.offset + 4].copy().view("<f4")[:, :, 0]
            assert np.array_equal(values, array)


def test_the_figures_of_a_foxglove_export_are_numbers(foxglove_file: Path) -> None:
    held = decoded_protobuf(foxglove_file)
    for message in rich_frames():
        if not isinstance(message, Reconstruction | Resultant):
            continue
        _, schema, figures = held[f"{message.topic}/figures"].pop(0)
        assert schema == "sparseskin.Figures"
        assert figures == figures_of(message)
        if isinstance(message, Resultant):
            assert ("row" in figures) == (message.row is not None)


def test_the_states_of_a_foxglove_export_are_json(foxglove_file: Path) -> None:
    held = decoded_protobuf(foxglove_file)
    (_, _, phi), (_, _, skin) = held["/skin/phi"][0], held["/skin/skin"][0]
    assert (phi["kind"], phi["n"], phi["m"], phi["seed"], phi["rows"]) == (
        "sbhe",
        34,
        M,
        7,
        "fixed",
    )
    assert np.array_equal([[cell == "1" for cell in row] for row in skin["mask"]], MASK)


def test_figures_have_every_number_of_their_message() -> None:
    numbers = {"iterations", "residual", "solve_ns", "done_ns", "skipped", "error", "trusted"}
    message = replace(rich_frames()[-1], error=0.1)
    assert numbers < figures_of(message).keys()


# --- ros2 ------------------------------------------------------------------------------------


def test_the_ros2_reader_of_mcap_finds_every_pixel_and_stamp(rich: Path) -> None:
    pytest.importorskip("mcap_ros2", reason="the extra ros2 is not installed")
    from mcap_ros2.reader import read_ros2_messages

    from sparseskin.plugins.bridges.exports.ros2 import export_ros2

    with BagReader(rich) as bag:
        mcap, _ = export_ros2(bag, rich.with_name("a_ros2"))
    held: dict[str, list[Any]] = {}
    for one in read_ros2_messages(str(mcap)):
        held.setdefault(one.channel.topic, []).append(one.ros_msg)
    sent = [m for m in rich_frames() if isinstance(m, Reconstruction)]
    for message, image in zip(sent, held["/skin/reconstruction"], strict=True):
        stamp = image.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == message.stamp_ns
        assert np.array_equal(np.frombuffer(bytes(image.data), "<f4"), message.forces.ravel())
    with_sd = [m.sd for m in sent if m.sd is not None]
    for sd, image in zip(with_sd, held["/skin/reconstruction/sd"], strict=True):
        assert np.array_equal(np.frombuffer(bytes(image.data), "<f4"), sd.ravel())
    trusted = [one.data for one in held["/skin/reconstruction/trusted"]]
    assert trusted == [m.trusted for m in sent if m.error is not None]
    assert [one.data for one in held["/skin/resultant/total"]] == [
        float(k) for k in range(N_FRAMES)
    ]
    assert json.loads(held["/skin/phi"][0].data)["seed"] == 7


def test_a_point_cloud_of_foxglove_has_normals_and_the_rows_of_the_points_file(
    tmp_path: Path,
) -> None:
    pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
    path = tmp_path / "a.mcap"
    state = points_bag(path)
    with BagReader(path) as bag:
        (made,) = export_foxglove(bag, path.with_name("a_foxglove.mcap"))
    _, _, cloud = decoded_protobuf(made)["/skin/taxels/points"][0]
    names = [field.name for field in cloud.fields]
    assert names == ["x", "y", "z", "force", "nx", "ny", "nz", "row"]
    table = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)
    (sent,) = (m for m in frame(0) if isinstance(m, Taxels))
    assert np.array_equal(table[:, 3], sent.forces[MASK])
    assert np.array_equal(table[:, [0, 1, 2, 4, 5, 6]], state.points)
    assert np.array_equal(table[:, 7].copy().view("<u4"), state.point_rows)
