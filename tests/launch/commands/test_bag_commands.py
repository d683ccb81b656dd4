"""The commands `sparseskin bag ...`."""

from __future__ import annotations

import builtins
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import LAG_NS, MASK, N_COLS, N_ROWS, PERIOD_NS, M, frame, frames, make_bag, skin_state

from sparseskin.launch.commands.cli import make_parser
from sparseskin.messages import (
    Measurements,
    Message,
    Reconstruction,
    SkinState,
    Taxels,
    Truth,
    decode,
)
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.files.recorded import open_file

N_FRAMES = 40

Bag = Callable[..., int]


@pytest.fixture
def bag(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Bag:
    """Run `sparseskin bag ARGUMENTS` in an empty folder; its exit code."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: object) -> int:
        words = ["bag", *map(str, arguments)]
        chosen = make_parser(words).parse_args(words)
        return int(chosen.run(chosen))

    return run


def decoded(path: Path) -> list[Message]:
    with BagReader(path) as opened:
        return [decode(m.topic.encode(), m.payload) for m in opened.messages()]


def of_kind(messages: list[Message], cls: type[Message], patch: str = "skin") -> list[Any]:
    return [message for message in messages if type(message) is cls and message.patch == patch]


# --- info ------------------------------------------------------------------------------------


def test_info_shows_topics_counts_rates_and_metadata_in_80_columns(
    bag: Bag, capsys: pytest.CaptureFixture[str]
) -> None:
    long_name = "a" * 32
    make_bag(Path("a.mcap"), [*frames(N_FRAMES), *frames(2, long_name)])
    assert bag("info", "a.mcap") == 0
    out = capsys.readouterr().out
    lines = out.splitlines()
    assert max(map(len, lines)) <= 80
    row = next(line.split() for line in lines if line.startswith("/skin/taxels"))
    assert row == ["/skin/taxels", "40", "100.00", "0.390", "2"]
    assert f"/{long_name}/reconstruction" in lines
    assert any(line.split() == ["scene", "test"] for line in lines)
    assert any(line.split() == ["state", "whole"] for line in lines)


def test_info_as_json_holds_the_same(bag: Bag, capsys: pytest.CaptureFixture[str]) -> None:
    make_bag(Path("a.mcap"), frames(N_FRAMES))
    assert bag("info", "a.mcap", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["topics"]["/skin/truth"]["n_messages"] == N_FRAMES
    assert found["topics"]["/skin/truth"]["rate_hz"] == pytest.approx(100.0)
    assert found["duration_s"] == pytest.approx(0.39)
    assert found["counts"] == {"lost": {"/skin/taxels": 2}}
    assert found["metadata"] == {"scene": "test", "seed": "3"}
    assert found["recovered"] == ""


def test_duration_is_that_of_the_streams_whatever_the_age_of_a_state(
    bag: Bag, capsys: pytest.CaptureFixture[str]
) -> None:
    state, *streams = frames(N_FRAMES)
    make_bag(Path("a.mcap"), [state, *(message.moved(10**10) for message in streams)])
    assert bag("info", "a.mcap", "--json") == 0
    assert json.loads(capsys.readouterr().out)["duration_s"] == pytest.approx(0.39)


def test_info_of_a_broken_bag_reports_what_survived(
    bag: Bag, capsys: pytest.CaptureFixture[str]
) -> None:
    make_bag(Path("a.mcap"), frames(N_FRAMES))
    data = Path("a.mcap").read_bytes()
    Path("b.mcap").write_bytes(data[: len(data) // 2])
    assert bag("info", "b.mcap") == 0
    assert "messages recovered, up to byte" in capsys.readouterr().out


# --- recover ---------------------------------------------------------------------------------


def test_recover_makes_a_whole_bag_of_what_survived(
    bag: Bag, capsys: pytest.CaptureFixture[str]
) -> None:
    payloads = make_bag(Path("a.mcap"), frames(N_FRAMES))
    data = Path("a.mcap").read_bytes()
    Path("b.mcap.part").write_bytes(data[: len(data) // 2])
    assert bag("recover", "b.mcap.part") == 0
    with BagReader("b.mcap.part") as broken, BagReader("b_recovered.mcap") as saved:
        found = list(saved.messages())
        assert found == list(broken.messages())
        assert [message.payload for message in found] == payloads[: len(found)]
        assert 0 < len(found) < len(payloads)
        assert saved.recovered == ""
        assert saved.metadata == {**broken.metadata, "recovered": broken.recovered}
        assert broken.recovered in capsys.readouterr().out
    with pytest.raises(BagError, match="exists already"):
        bag("recover", "b.mcap.part")


# --- import ----------------------------------------------------------------------------------


def test_several_files_become_one_bag_each_in_a_folder(bag: Bag) -> None:
    for k in range(2):
        np.save(f"f{k}.npy", np.full((3, 2, 2), 1.0 + k))
    assert bag("import", "f0.npy", "f1.npy", "--out", "bags", "--f-max", "5") == 0
    for k in range(2):
        state, *taxels = decoded(Path(f"bags/f{k}.mcap"))
        assert isinstance(state, SkinState)
        assert state.f_max == 5.0
        assert [message.forces[0, 0] for message in taxels if isinstance(message, Taxels)] == [
            1.0 + k
        ] * 3
    with pytest.raises(BagError, match="several files need a folder"):
        bag("import", "f0.npy", "f1.npy", "--out", "one.mcap")


def test_a_plain_csv_is_imported_with_what_is_stated(bag: Bag) -> None:
    Path("a.csv").write_text("1,2,3,4,5,6\n6,5,4,3,2,1\n")
    stated = ("--n-rows", 2, "--n-cols", 3, "--unit", "N", "--rate-hz", 50)
    assert bag("import", "a.csv", "--out", "a.mcap", *stated) == 0
    state, first, second = decoded(Path("a.mcap"))
    assert isinstance(state, SkinState)
    assert (state.skin.shape, state.unit, state.rate_hz) == ((2, 3), "N", 50.0)
    assert (first.stamp_ns, second.stamp_ns) == (0, 20_000_000)


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("a.npy", b"no array", "not a readable NumPy file"),
        ("a.xyz", b"1,2,3\n", "suffix '.xyz' is not known"),
        ("a.csv", b"1,2,3\n", "does not state its shape"),
    ],
)
def test_a_file_that_cannot_be_imported_leaves_nothing_behind(
    bag: Bag, name: str, content: bytes, text: str
) -> None:
    Path(name).write_bytes(content)
    with pytest.raises(SparseskinError, match=text):
        bag("import", name, "--out", "out.mcap")
    assert [path.name for path in Path().iterdir()] == [name]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ((), "n_rows.csv, line 1: .*set --n-rows and --n-cols "),
        (("--n-rows", 2), "n_rows.csv, line 1: 3 cells cannot be divided by --n-rows = 2"),
        (("--n-rows", 1), "n_rows.csv: .*set --unit, e.g. N"),
    ],
)
def test_an_import_that_is_refused_names_its_options(
    bag: Bag, options: tuple[object, ...], text: str
) -> None:
    Path("n_rows.csv").write_text("1,2,3\n")
    with pytest.raises(SparseskinError, match=text):
        bag("import", "n_rows.csv", "--out", "out.mcap", *options)


# --- export ----------------------------------------------------------------------------------


def test_an_exported_npz_holds_every_array_and_is_read_back_equal_as_a_source(bag: Bag) -> None:
    messages = frames(N_FRAMES)
    make_bag(Path("a.mcap"), messages)
    assert bag("export", "a.mcap", "--to", "npz") == 0
    with np.load("a.npz") as arrays:
        for name, cls in (("forces", Taxels), ("truth", Truth), ("reconstruction", Reconstruction)):
            expected = np.stack([message.forces for message in of_kind(messages, cls)])
            assert arrays[name].dtype == np.float32
            assert np.array_equal(arrays[name], expected)
        y = np.stack([message.y for message in of_kind(messages, Measurements)])
        assert np.array_equal(arrays["measurements"], y)
        assert list(arrays["measurements_stamp_ns"]) == [k * PERIOD_NS for k in range(N_FRAMES)]
    opened = open_file("a.npz")
    skin = skin_state().skin
    assert (opened.skin.shape, opened.skin.f_max, opened.skin.unit) == (skin.shape, 2.5, "N")
    assert opened.skin.pitch_m == skin.pitch_m
    assert np.array_equal(opened.skin.mask, MASK)  # type: ignore[arg-type]
    assert opened.rate_hz == 100.0
    taxels = of_kind(messages, Taxels)
    for message, (stamp_ns, forces) in zip(taxels, opened, strict=True):
        assert stamp_ns == message.stamp_ns
        assert np.array_equal(forces, message.forces)


def test_each_patch_gets_an_npz_of_its_own(bag: Bag) -> None:
    make_bag(Path("a.mcap"), [*frames(3, "left"), *frames(4, "right")])
    assert bag("export", "a.mcap", "--to", "npz", "--out", "b.npz") == 0
    assert open_file("b_left.npz").n_frames == 3
    assert open_file("b_right.npz").n_frames == 4


def test_measurements_whose_number_changes_are_filled_up_with_nan(bag: Bag) -> None:
    short = Measurements(stamp_ns=PERIOD_NS, patch="skin", y=np.ones(4, np.float32), phi="0" * 16)
    make_bag(Path("a.mcap"), [of_kind(frames(1), Measurements)[0], short])
    assert bag("export", "a.mcap", "--to", "npz") == 0
    with np.load("a.npz") as arrays:
        assert arrays["measurements"].shape == (2, M)
        assert np.isfinite(arrays["measurements"][0]).all()
        assert np.array_equal(np.isnan(arrays["measurements"][1]), np.arange(M) >= 4)


def test_an_exported_csv_is_read_back_equal_as_a_source(bag: Bag) -> None:
    messages = frames(N_FRAMES)
    make_bag(Path("a.mcap"), messages)
    assert bag("export", "a.mcap", "--to", "csv") == 0
    assert sorted(path.name for path in Path("a_csv").iterdir()) == [
        *("skin_measurements.csv", "skin_reconstruction.csv", "skin_taxels.csv"),
        *("skin_truth.csv", "stamps.csv"),
    ]
    opened = open_file("a_csv/skin_taxels.csv", n_rows=N_ROWS, n_cols=N_COLS, unit="N")
    for message, (_, forces) in zip(of_kind(messages, Taxels), opened, strict=True):
        assert np.array_equal(forces, message.forces)
    header, *lines = Path("a_csv/stamps.csv").read_text().splitlines()
    assert header == "topic,frame,stamp_ns"
    truth = [line for line in lines if line.startswith("/skin/truth,")]
    assert truth == [f"/skin/truth,{k},{k * PERIOD_NS}" for k in range(N_FRAMES)]


def test_only_the_topics_asked_for_are_exported(bag: Bag) -> None:
    make_bag(Path("a.mcap"), frames(3))
    assert bag("export", "a.mcap", "--to", "csv", "--topics", "/skin/truth") == 0
    assert sorted(path.name for path in Path("a_csv").iterdir()) == ["skin_truth.csv", "stamps.csv"]
    with pytest.raises(BagError, match="did you mean '/skin/truth'"):
        bag("export", "a.mcap", "--to", "npz", "--topics", "/skin/truths")
    with pytest.raises(BagError, match="/skin/skin holds no frames"):
        bag("export", "a.mcap", "--to", "npz", "--topics", "/skin/skin")


@pytest.mark.parametrize("kind", ["npz", "csv", "ros2"])
def test_an_export_overwrites_nothing(bag: Bag, kind: str) -> None:
    make_bag(Path("a.mcap"), frames(1))
    Path("taken").write_bytes(b"precious")
    with pytest.raises(SparseskinError, match="taken: exists already"):
        bag("export", "a.mcap", "--to", kind, "--out", "taken")
    assert Path("taken").read_bytes() == b"precious"
    with pytest.raises(SparseskinError, match="folder does not exist"):
        bag("export", "a.mcap", "--to", kind, "--out", "none/b")
    assert sorted(path.name for path in Path().iterdir()) == ["a.mcap", "taken"]


def _other_shape() -> Any:
    return np.zeros((2, 2), np.float32)


def test_frames_of_two_shapes_are_refused_by_npz_and_leave_nothing(bag: Bag) -> None:
    other = Taxels(stamp_ns=5, patch="skin", forces=_other_shape())
    make_bag(Path("a.mcap"), [frame(0)[0], other])
    with pytest.raises(BagError, match="a frame of 2 x 2 after some of 5 x 7"):
        bag("export", "a.mcap", "--to", "npz")
    assert [path.name for path in Path().iterdir()] == ["a.mcap"]


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
    late = Taxels(stamp_ns=(1 << 31) * 10**9, patch="skin", forces=_other_shape())
    make_bag(Path("a.mcap"), [late])
    with pytest.raises(BagError, match="beyond what ROS 2 can hold"):
        bag("export", "a.mcap", "--to", "ros2")
    assert [path.name for path in Path().iterdir()] == ["a.mcap"]


def test_a_broken_bag_is_exported_as_far_as_it_goes_and_reports_it(
    bag: Bag, capsys: pytest.CaptureFixture[str]
) -> None:
    make_bag(Path("a.mcap"), frames(N_FRAMES))
    data = Path("a.mcap").read_bytes()
    Path("b.mcap").write_bytes(data[: len(data) // 2])
    assert bag("export", "b.mcap", "--to", "npz") == 0
    assert "messages recovered, up to byte" in capsys.readouterr().err
    with BagReader("b.mcap") as broken:
        assert open_file("b.npz").n_frames == broken.topics["/skin/taxels"].n_messages


def test_an_export_of_no_frames_is_refused(bag: Bag) -> None:
    make_bag(Path("a.mcap"), [skin_state()])
    with pytest.raises(BagError, match="holds no frames to export"):
        bag("export", "a.mcap", "--to", "npz")
