"""Exports of bags: nothing is lost, and other programs' readers find every number."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import LAG_NS, MASK, N_COLS, N_ROWS, PERIOD_NS, PHI, M, frame, make_bag, skin_state
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sparseskin.messages import (
    Calibration,
    Measurements,
    Message,
    PhiState,
    Reconstruction,
    Resultant,
    SkinState,
    SolverState,
    Taxels,
    decode,
)
from sparseskin.messages.base import wire_fields
from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.convert.csv import export_csv
from sparseskin.nodes.recorder.convert.figures import (
    descriptor,
    encoded,
    figure_values,
    schema_name,
)
from sparseskin.nodes.recorder.convert.npz import export_npz
from sparseskin.nodes.recorder.convert.to_bag import import_file
from sparseskin.nodes.sensor.files.recorded import open_file

N_FRAMES = 12


def rich_frames() -> list[Message]:
    """Messages with all that exports must keep: each optional field both with and without."""
    found: list[Message] = [
        skin_state(),
        PhiState(
            stamp_ns=1, patch="skin", kind="sbhe", n=34, m=M, block=32, seed=7, fingerprint=PHI
        ),
        SolverState(
            stamp_ns=1, patch="skin", solver="skin", basis="", preset="", iterations=3, lambda_n=0.0
        ),
    ]
    for k in range(N_FRAMES):
        taxels, truth, measurements, reconstruction = frame(k)
        rng = np.random.default_rng(100 + k)
        if k % 3 == 1:
            codes = rng.integers(-7, 8, M).astype(np.int32)
            measurements = replace(measurements, y=Quantised.of(codes, 4, 0.125))
        if k % 3 == 2:
            places = np.packbits(np.arange(N_ROWS * N_COLS) < M - k % 2)
            y = rng.normal(size=M - k % 2).astype(np.float32)
            measurements = replace(measurements, y=y, places=places)
        if k % 2:
            sd = rng.uniform(0, 0.1, (N_ROWS, N_COLS)).astype(np.float32)
            reconstruction = replace(reconstruction, sd=sd, error=0.25, trusted=k != 3, skipped=k)
        touched = {"row": 1.5, "col": 2.5, "row_sd": 0.1, "col_sd": 0.2} if k % 2 else {}
        resultant = Resultant(
            stamp_ns=k * PERIOD_NS, patch="skin", total=float(k), total_sd=0.5, done_ns=3, **touched
        )
        found += [taxels, truth, measurements, resultant, reconstruction]
        if k == 5:
            found.append(replace(skin_state(), stamp_ns=k * PERIOD_NS, rate_hz=50.0, mask=None))
            gains = np.full((N_ROWS, N_COLS), 2.0, np.float32)
            reading = np.arange(3, dtype=np.float32).reshape(3, 1, 1)
            found.append(
                Calibration(
                    stamp_ns=k * PERIOD_NS,
                    patch="skin",
                    name="palm",
                    baseline=None,
                    gains=gains,
                    response_reading=reading,
                    response_force=reading.ravel(),
                )
            )
    return [m.published("0123456789abcdef", seq) for seq, m in enumerate(found)]


@pytest.fixture
def rich(tmp_path: Path) -> Path:
    make_bag(tmp_path / "a.mcap", rich_frames())
    return tmp_path / "a.mcap"


def by_topic(path: Path) -> dict[str, list[tuple[int, Message]]]:
    found: dict[str, list[tuple[int, Message]]] = {}
    with BagReader(path) as bag:
        for one in bag.messages():
            message = decode(one.topic.encode(), one.payload)
            found.setdefault(one.topic, []).append((one.log_time_ns, message))
    return found


def refusal(read: Callable[[], object]) -> str:
    """The line of a refusal; "" where there is none."""
    try:
        read()
    except SparseskinError as error:
        return str(error)
    return ""


# --- points ----------------------------------------------------------------------------------


@pytest.fixture
def on_points(tmp_path: Path) -> tuple[Path, SkinState]:
    """A bag of a skin of points from a file, whose order is not that of the grid."""
    rng, n = np.random.default_rng(5), int(MASK.sum())
    points = np.zeros((n, 6), np.float32)
    points[:, :3], points[:, 5] = rng.normal(size=(n, 3)), 1
    rows = rng.permutation(n).astype(np.int32)
    state = replace(skin_state(), points=points, point_rows=rows)
    make_bag(tmp_path / "a.mcap", [state, *frame(0), *frame(1)])
    return tmp_path / "a.mcap", state


def test_an_npz_has_the_row_of_the_points_file_of_each_taxel(
    on_points: tuple[Path, SkinState],
) -> None:
    path, state = on_points
    with BagReader(path) as bag:
        (npz,) = export_npz(bag, path.with_name("a.npz"))
    assert import_file(npz, path.with_name("b.mcap")) == 2
    assert by_topic(path.with_name("b.mcap")) == by_topic(path)
    skin = open_file(npz).skin
    assert skin.point_rows is not None
    assert state.point_rows is not None
    assert np.array_equal(skin.point_rows, state.point_rows)
    with np.load(npz) as arrays:
        assert np.array_equal(arrays["point_rows"], state.point_rows)
        assert np.array_equal(arrays["points"], state.points)
        changed = {**arrays, "point_rows": arrays["point_rows"][:-1]}
    np.savez(path.with_name("c.npz"), **changed)
    n = len(state.point_rows)
    line = f"array 'point_rows': int32 of shape ({n - 1},); expected whole numbers of ({n},)"
    assert line in refusal(lambda: open_file(path.with_name("c.npz")))


def test_a_csv_has_the_row_of_the_points_file_above_each_column(
    on_points: tuple[Path, SkinState],
) -> None:
    path, state = on_points
    assert state.point_rows is not None
    with BagReader(path) as bag:
        export_csv(bag, path.with_name("a_csv"))
    sent = [m for m in frame(0) if isinstance(m, Reconstruction)]
    for name in ("skin_taxels", "skin_reconstruction"):
        file = path.with_name("a_csv") / f"{name}.csv"
        lines = file.read_text().splitlines()
        above = dict(zip(lines[3].split(","), lines[2].split(","), strict=True))
        assert above["stamp_ns"] == "# point_rows"
        left = iter(state.point_rows.tolist())
        for (row, col), exists in np.ndenumerate(MASK):
            assert above[f"r{row}c{col}"] == (str(next(left)) if exists else "")
        source = open_file(file)
    assert np.array_equal(next(iter(source))[1], sent[0].forces)
    measured = (path.with_name("a_csv") / "skin_measurements.csv").read_text()
    assert "# point_rows" not in measured


def test_a_point_cloud_of_foxglove_has_normals_and_the_rows_of_the_points_file(
    on_points: tuple[Path, SkinState],
) -> None:
    pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
    from sparseskin.nodes.recorder.convert.foxglove import export_foxglove

    path, state = on_points
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


# --- npz -------------------------------------------------------------------------------------


def test_an_imported_export_has_every_message_of_the_bag_again(rich: Path) -> None:
    with BagReader(rich) as bag:
        (npz,) = export_npz(bag, rich.with_name("a.npz"))
        metadata, counts = bag.metadata, bag.counts
    assert import_file(npz, rich.with_name("b.mcap")) == N_FRAMES
    assert by_topic(rich.with_name("b.mcap")) == by_topic(rich)
    with BagReader(rich.with_name("b.mcap")) as again:
        assert (again.metadata, again.counts) == (metadata, counts)
        (second,) = export_npz(again, rich.with_name("b.npz"))
    with np.load(npz) as one, np.load(second) as two:
        assert set(one) == set(two)
        for name in one:
            assert (one[name].dtype, one[name].tobytes()) == (two[name].dtype, two[name].tobytes())


def test_an_imported_export_has_quantised_measurements_in_their_bits(rich: Path) -> None:
    with BagReader(rich) as bag:
        (npz,) = export_npz(bag, rich.with_name("a.npz"))
    import_file(npz, rich.with_name("b.mcap"))
    sent = [message for _, message in by_topic(rich.with_name("b.mcap"))["/skin/measurements"]]
    bits = [
        m.y.bits if isinstance(m.y, Quantised) else 0 for m in sent if isinstance(m, Measurements)
    ]
    assert bits == [4 if k % 3 == 1 else 0 for k in range(N_FRAMES)]


def test_an_npz_names_what_it_holds(rich: Path) -> None:
    with BagReader(rich) as bag:
        (npz,) = export_npz(bag, rich.with_name("a.npz"))
    with np.load(npz) as arrays:
        assert arrays["phi_seed"].tolist() == [7]
        assert arrays["phi_rows"].tolist() == ["fixed"]
        assert arrays["reconstruction_trusted"].tolist() == [k != 3 for k in range(N_FRAMES)]
        assert np.isnan(arrays["reconstruction_sd"][0]).all()
        assert np.isfinite(arrays["reconstruction_sd"][1]).all()
        assert arrays["resultant_total"].tolist() == [float(k) for k in range(N_FRAMES)]
        assert np.array_equal(np.isnan(arrays["resultant_row"]), np.arange(N_FRAMES) % 2 == 0)
        assert arrays["rate_hz"] == 50.0  # the last state


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_an_export_with_any_array_changed_is_imported_or_refused_in_one_line(
    rich: Path, data: st.DataObject
) -> None:
    npz = rich.with_name("a.npz")
    if not npz.exists():
        with BagReader(rich) as bag:
            export_npz(bag, npz)
    with np.load(npz) as held:
        arrays = {name: held[name] for name in held}
    name = data.draw(st.sampled_from(sorted(arrays.keys() - {"sparseskin_format"})))
    value = data.draw(
        st.sampled_from(
            [None, np.nan, np.inf, -1, 2**62, "x", "[" * 9999, np.zeros((2, 2)), np.zeros(0)]
        )
    )
    if value is None:
        del arrays[name]
    elif isinstance(value, np.ndarray):
        arrays[name] = value
    else:
        arrays[name] = np.full(arrays[name].shape, value)
    np.savez(changed := rich.with_name("changed.npz"), **arrays)
    out = rich.with_name("changed.mcap")
    line = refusal(lambda: import_file(changed, out))
    assert line.isprintable()
    assert out.exists() == (line == "")
    out.unlink(missing_ok=True)


# --- csv -------------------------------------------------------------------------------------


def test_an_exported_csv_states_its_skin_and_is_read_as_it_is(rich: Path) -> None:
    with BagReader(rich) as bag:
        paths = export_csv(bag, rich.with_name("a_csv"))
    names = {path.name for path in paths}
    assert {"skin_resultant.csv", "skin_reconstruction_sd.csv", "stamps.csv"} < names
    source = open_file(rich.with_name("a_csv") / "skin_taxels.csv")
    sent = [m for m in rich_frames() if isinstance(m, Taxels)]
    assert (source.skin.f_max, source.skin.unit, source.skin.pitch_m) == (2.5, "N", 0.005)
    assert source.rate_hz == 50.0
    for message, (stamp_ns, forces) in zip(sent, source, strict=True):
        assert stamp_ns == message.stamp_ns
        assert np.array_equal(forces, message.forces)


def test_an_exported_csv_is_a_table_with_a_header(rich: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    with BagReader(rich) as bag:
        export_csv(bag, rich.with_name("a_csv"))
    sent = [m for m in rich_frames() if isinstance(m, Reconstruction)]
    table = pandas.read_csv(rich.with_name("a_csv") / "skin_reconstruction.csv", comment="#")
    assert table["stamp_ns"].tolist() == [m.stamp_ns for m in sent]
    assert table["trusted"].tolist() == [m.trusted for m in sent]
    assert table["error"].isna().tolist() == [m.error is None for m in sent]
    cells = table.loc[:, "r0c0":].to_numpy(np.float32).reshape(-1, N_ROWS, N_COLS)
    assert np.array_equal(cells, np.stack([m.forces for m in sent]))
    sd = pandas.read_csv(rich.with_name("a_csv") / "skin_reconstruction_sd.csv", comment="#")
    expected = np.stack([m.sd for m in sent if m.sd is not None])
    assert np.array_equal(sd.loc[:, "r0c0":].to_numpy(np.float32).reshape(expected.shape), expected)


def test_the_mask_of_an_exported_csv_is_that_of_the_skin(tmp_path: Path) -> None:
    make_bag(tmp_path / "a.mcap", [skin_state(), *frame(0)])
    with BagReader(tmp_path / "a.mcap") as bag:
        export_csv(bag, tmp_path / "a_csv")
    mask = open_file(tmp_path / "a_csv" / "skin_truth.csv").skin.mask
    assert mask is not None
    assert np.array_equal(mask, MASK)


@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(place=st.integers(0, 3000), piece=st.text('r0c,1#{}[]"\n-.', max_size=6))
def test_a_changed_csv_is_read_or_refused_in_one_line(rich: Path, place: int, piece: str) -> None:
    folder = rich.with_name("a_csv")
    if not folder.exists():
        with BagReader(rich) as bag:
            export_csv(bag, folder)
    text = (folder / "skin_taxels.csv").read_text()
    changed = rich.with_name("changed.csv")
    changed.write_text(text[:place] + piece + text[place + len(piece) :])
    assert refusal(lambda: open_file(changed)).isprintable()


# --- foxglove --------------------------------------------------------------------------------


@pytest.fixture
def foxglove_file(rich: Path) -> Path:
    pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
    from sparseskin.nodes.recorder.convert.foxglove import export_foxglove

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
        assert schema == schema_name(type(message))
        for name, expected in figure_values(message).items():
            assert getattr(figures, name) == expected, name
        if isinstance(message, Resultant):
            assert figures.HasField("row") == (message.row is not None)


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


@given(st.floats(allow_nan=False), st.integers(0, 2**63 - 1), st.integers(0, 1_000_000))
def test_figures_are_what_protobuf_reads(residual: float, stamp_ns: int, iterations: int) -> None:
    protobuf = pytest.importorskip("google.protobuf.descriptor_pb2", reason="no protobuf")
    pool = pytest.importorskip("google.protobuf.descriptor_pool").DescriptorPool()
    factory = pytest.importorskip("google.protobuf.message_factory")
    files = protobuf.FileDescriptorSet.FromString(descriptor(Reconstruction))
    pool.Add(files.file[0])
    cls = factory.GetMessageClass(pool.FindMessageTypeByName(schema_name(Reconstruction)))
    values = {"residual": residual, "stamp_ns": stamp_ns, "iterations": iterations, "trusted": True}
    read = cls.FromString(encoded(Reconstruction, values))
    assert {name: getattr(read, name) for name in values} == values
    assert not read.HasField("error")


def test_figures_have_every_number_of_their_message() -> None:
    numbers = {"iterations", "residual", "solve_ns", "done_ns", "skipped", "error", "trusted"}
    assert numbers < figure_values(replace(rich_frames()[-1], error=0.1)).keys()
    assert "forces" in wire_fields(Reconstruction)


# --- ros2 ------------------------------------------------------------------------------------


def test_the_ros2_reader_of_mcap_finds_every_pixel_and_stamp(rich: Path) -> None:
    pytest.importorskip("mcap_ros2", reason="the extra ros2 is not installed")
    from mcap_ros2.reader import read_ros2_messages

    from sparseskin.nodes.recorder.convert.ros2 import export_ros2

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
