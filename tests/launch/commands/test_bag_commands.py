"""The commands `sparseskin recording ...` and `sparseskin play --open`."""

import json
import signal
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from bags import frame, frames, make_bag, record_scene, run_bag, skin_state

from sparseskin.launch.commands.cli import main
from sparseskin.messages import Taxels, decode
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.files.file_source import open_file

N_FRAMES = 40


@pytest.fixture
def bag(monkeypatch, tmp_path):
    """Runs `sparseskin recording ARGUMENTS` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return run_bag


def decoded(path):
    with BagReader(path) as opened:
        return [decode(m.topic.encode(), m.payload) for m in opened.messages()]


def make_half_a_bag(name):
    """The first half of the bytes of a bag; the payloads of the whole one."""
    payloads = make_bag(Path("a.mcap"), frames(N_FRAMES))
    data = Path("a.mcap").read_bytes()
    Path(name).write_bytes(data[: len(data) // 2])
    return payloads


def test_info_shows_topics_counts_rates_and_metadata_in_80_columns(bag, capsys):
    long_name = "a" * 24
    make_bag(Path("a.mcap"), [*frames(N_FRAMES), *frames(2, long_name)])
    assert bag("info", "a.mcap") == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    row = next(line.split() for line in lines if line.endswith("/skin/taxels"))
    assert row == ["40", "100.00", "0.39", "2", "/skin/taxels"]
    assert any(line.endswith(f" /{long_name}/reconstruction") for line in lines)
    assert any(line.split() == ["scene", "test"] for line in lines)
    assert any(line.split() == ["state", "whole"] for line in lines)


def test_info_as_json_holds_the_same_whatever_the_age_of_a_state(bag, capsys):
    state, *streams = frames(N_FRAMES)
    make_bag(Path("a.mcap"), [state, *(message.moved(10**10) for message in streams)])
    assert bag("info", "a.mcap", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["topics"]["/skin/truth"]["n_messages"] == N_FRAMES
    assert found["topics"]["/skin/truth"]["rate_hz"] == pytest.approx(100.0)
    assert found["duration_s"] == pytest.approx(0.39)  # that of the streams
    assert found["counts"] == {"lost": {"/skin/taxels": 2}}
    assert found["metadata"] == {"scene": "test", "seed": "3"}
    assert found["recovered"] == ""


def test_recover_makes_a_whole_bag_of_what_survived(bag, capsys):
    payloads = make_half_a_bag("b.mcap.part")
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


def test_a_plain_csv_is_imported_with_what_is_stated(bag):
    Path("a.csv").write_text("3,1,4,1,5,9\n6,5,4,3,2,1\n")
    stated = ("--n-rows", 2, "--n-cols", 3, "--unit", "N", "--rate-hz", 50)
    assert bag("import", "a.csv", "--out", "a.mcap", *stated) == 0
    state, first, second = decoded(Path("a.mcap"))
    assert state.skin.shape == (2, 3)
    assert state.unit == "N"
    assert state.rate_hz == 50.0
    assert first.stamp_ns == 0
    assert second.stamp_ns == 20_000_000


def test_only_the_topics_asked_for_are_exported(bag):
    make_bag(Path("a.mcap"), frames(3))
    assert bag("export", "a.mcap", "--to", "csv", "--topics", "/skin/truth") == 0
    assert sorted(path.name for path in Path("a_csv").iterdir()) == ["skin_truth.csv"]
    with pytest.raises(BagError, match="did you mean '/skin/truth'"):
        bag("export", "a.mcap", "--to", "npz", "--topics", "/skin/truths")
    with pytest.raises(BagError, match="/skin/skin holds no frames"):
        bag("export", "a.mcap", "--to", "npz", "--topics", "/skin/skin")
    make_bag(Path("b.mcap"), [skin_state()])
    with pytest.raises(BagError, match="holds no frames to export"):
        bag("export", "b.mcap", "--to", "npz")


def test_an_export_overwrites_nothing_and_leaves_nothing_where_it_is_refused(bag):
    make_bag(Path("a.mcap"), frames(1))
    Path("taken").write_bytes(b"precious")
    with pytest.raises(SparseskinError, match="taken: exists already"):
        bag("export", "a.mcap", "--to", "npz", "--out", "taken")
    assert Path("taken").read_bytes() == b"precious"
    with pytest.raises(SparseskinError, match="folder does not exist"):
        bag("export", "a.mcap", "--to", "npz", "--out", "none/b")
    assert sorted(path.name for path in Path().iterdir()) == ["a.mcap", "taken"]


def test_frames_of_two_shapes_are_refused_by_npz_and_leave_nothing(bag):
    other = Taxels(stamp_ns=5, patch="skin", forces=np.zeros((2, 2), np.float32))
    make_bag(Path("a.mcap"), [frame(0)[0], other])
    with pytest.raises(BagError, match="a frame of 2 x 2 after some of 5 x 7"):
        bag("export", "a.mcap", "--to", "npz")
    assert [path.name for path in Path().iterdir()] == ["a.mcap"]


def test_a_broken_bag_is_exported_as_far_as_it_goes_and_reports_it(bag, capsys):
    make_half_a_bag("b.mcap")
    assert bag("export", "b.mcap", "--to", "npz") == 0
    assert "messages recovered, up to byte" in capsys.readouterr().err
    with BagReader("b.mcap") as broken:
        assert open_file("b.npz").n_frames == broken.topics["/skin/taxels"].n_messages


@pytest.mark.parametrize(
    "schemas", [(), ("skin", "taxels"), ("skin", "phi", "measurements")]
)
def test_too_little_to_show_is_one_line(tmp_path, capsys, schemas):
    path = tmp_path / "some.mcap"
    make_bag(path, [m for m in frames(3) if m.schema in schemas])
    assert main(["play", str(path), "--open"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{path}: --open: has no reconstructions of all patches; ")


def test_the_page_shows_a_recording_again_and_again(start, tmp_path):
    record_scene(tmp_path / "some.mcap", "path_40", 300, 20, 1)
    play = start("play", "some.mcap", "--open")
    url = play.wait_for("live page: ").split()[0]
    play.wait_for("ready: player, monitor")
    with urllib.request.urlopen(url) as page:
        assert b"<title>sparseskin" in page.read()
    # More frames than the recording has.
    echo = start("topic", "echo", "/skin/reconstruction", "-n", "50", "--json")
    code, lines, _ = echo.finish()
    assert code == 0
    assert len({json.loads(line)["stamp_ns"] for line in lines.splitlines()}) == 50
    play.process.send_signal(signal.SIGINT)
    assert play.finish()[0] == 130
