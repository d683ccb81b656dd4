"""Reprocessing: the same settings give the same bits, whatever the way and the executor."""

import json
import os

import pytest
from bags import record_scene
from documented import check

from sparseskin.launch.commands.cli import main
from sparseskin.launch.commands.options import bag_names
from sparseskin.messages import Reconstruction, Taxels, decode
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.recorder import node as recorder_node
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.tasks import make_executor


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "box.mcap"
    return record_scene(path, "lift_box_40", 320, 40, 4)


def maps(path, kind):
    """Stamps and forces of all frames of one schema."""
    with BagReader(path) as bag:
        assert bag.recovered == ""
        found = []
        for recorded in bag.messages([f"/skin/{kind.schema}"]):
            message = decode(recorded.topic.encode(), recorded.payload)
            found.append((message.stamp_ns, message.forces.tobytes()))
        return found


@pytest.mark.parametrize("start_from", ["auto", "taxels"])
def test_the_same_settings_give_the_same_bits_and_stamps(
    recording, tmp_path, start_from
):
    out = tmp_path / "out.mcap"
    summary = tmp_path / "out.json"
    more = ["--from", start_from, "--summary", str(summary)]
    assert main(["reprocess", str(recording), "--out", str(out), *more]) == 0
    check(json.loads(summary.read_text()))
    for kind in (Reconstruction, Taxels):
        assert maps(out, kind) == maps(recording, kind)


@pytest.mark.parametrize("change", ["reconstructor.iterations=5", "compressor.ratio=4"])
def test_other_settings_give_another_reconstruction_of_the_same_frames(
    recording, tmp_path, change
):
    out = tmp_path / "out.mcap"
    assert main(["reprocess", str(recording), "--out", str(out), "--set", change]) == 0
    old = maps(recording, Reconstruction)
    new = maps(out, Reconstruction)
    assert [stamp for stamp, _ in old] == [stamp for stamp, _ in new]
    assert old != new
    assert maps(out, Taxels) == maps(recording, Taxels)


def test_iterations_that_followed_from_a_host_are_those_of_the_recording(
    recording, tmp_path
):
    """A budget that nothing fits into leaves one iteration on any host."""
    few = tmp_path / "few.mcap"
    again = tmp_path / "again.mcap"
    budget = ["--set", "reconstructor.budget_ms=0.05"]
    assert main(["reprocess", str(recording), "--out", str(few), *budget]) == 0
    assert main(["reprocess", str(few), "--out", str(again)]) == 0
    assert maps(few, Reconstruction) == maps(again, Reconstruction)
    assert main(["reprocess", str(again), "--out", str(tmp_path / "third.mcap")]) == 0
    assert maps(few, Reconstruction) == maps(tmp_path / "third.mcap", Reconstruction)
    assert maps(few, Reconstruction) != maps(recording, Reconstruction)


@pytest.mark.slow
def test_in_several_processes_the_bits_are_the_same(recording, tmp_path):
    twin = tmp_path / "twin.mcap"
    twin.write_bytes(recording.read_bytes())
    out = tmp_path / "out"
    out.mkdir()
    arguments = [
        str(recording),
        str(twin),
        "--out",
        str(out),
        "--executor",
        "process:2",
    ]
    assert main(["reprocess", *arguments]) == 0
    for name in ("box.mcap", "twin.mcap"):
        assert maps(out / name, Reconstruction) == maps(recording, Reconstruction)


def test_of_several_recordings_the_sound_ones_are_finished(recording, tmp_path, capsys):
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"no recording")
    out = tmp_path / "out"
    assert main(["reprocess", str(bad), str(recording), "--out", str(out)]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert str(bad) in captured.err
    assert "box.mcap:" in captured.out
    assert [path.name for path in out.iterdir()] == ["box.mcap"]


def test_one_recording_goes_into_a_folder_that_is_named_as_one(tmp_path):
    folder = tmp_path / "results"
    assert bag_names(["day1.mcap"], f"{folder}/") == [str(folder / "day1.mcap")]
    assert folder.is_dir()


def test_a_batch_that_is_repeated_computes_what_is_missing_and_nothing_else(
    recording, tmp_path, capsys
):
    twin = tmp_path / "twin.mcap"
    out = tmp_path / "out"
    twin.write_bytes(recording.read_bytes())
    command = ["reprocess", str(recording), str(twin), "--out", str(out)]
    assert main(command) == 0
    finished = {path.name: path.read_bytes() for path in out.iterdir()}
    assert finished.keys() == {"box.mcap", "twin.mcap"}

    (out / "twin.mcap").unlink()
    capsys.readouterr()
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert f"{out / 'box.mcap'}: computed before" in printed
    assert f"{out / 'twin.mcap'}: computed before" not in printed
    assert (out / "box.mcap").read_bytes() == finished["box.mcap"]
    assert maps(out / "twin.mcap", Reconstruction) == maps(recording, Reconstruction)


@pytest.mark.parametrize("change", ["settings", "source", "version", "result"])
def test_a_result_of_anything_else_is_not_written_over(
    recording, tmp_path, capsys, monkeypatch, change
):
    source = tmp_path / "box.mcap"
    out = tmp_path / "out.mcap"
    source.write_bytes(recording.read_bytes())
    command = ["reprocess", str(source), "--out", str(out)]
    assert main(command) == 0
    if change == "settings":
        command += ["--set", "reconstructor.iterations=5"]
    elif change == "source":
        newer_ns = out.stat().st_mtime_ns + 10**9
        os.utime(source, ns=(newer_ns, newer_ns))
    elif change == "version":
        monkeypatch.setattr(recorder_node, "version", lambda package: "9.9.9")
    else:
        out.write_bytes(out.read_bytes()[:-100])
    before = out.read_bytes()
    capsys.readouterr()
    assert main(command) == 2
    assert "exists already" in capsys.readouterr().err
    assert out.read_bytes() == before


def test_a_full_disk_is_one_line_that_names_the_output(recording, mount_disk, capsys):
    out = mount_disk("80k") / "q.mcap"
    assert main(["reprocess", str(recording), "--out", str(out)]) == 2
    expected = f"{out}: No space left on device; nothing was written\n"
    assert capsys.readouterr().err == expected
    assert list(out.parent.iterdir()) == []


def test_executors_by_text(monkeypatch, tmp_path):
    (tmp_path / "my_pool.py").write_text(
        "from concurrent.futures import ThreadPoolExecutor\n"
        "def make(): return ThreadPoolExecutor(1)\n"
        "def wrong(): return 3\n"
        "def broken(): raise RuntimeError('no cluster')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    for spec in ("thread:2", "process:1", "my_pool:make"):
        with make_executor(spec) as pool:
            assert pool.submit(abs, -3).result() == 3
    for spec, text in (
        ("my_pool:wrong", "made int"),
        ("my_pool:broken", "RuntimeError: no cluster"),
        ("thread", "expected serial, process:N"),
    ):
        with pytest.raises(SettingsError, match=text):
            make_executor(spec)
