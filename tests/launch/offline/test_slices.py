"""Slices of a recording: the same frames as in one pass, each once, whatever was interrupted."""

from __future__ import annotations

import json
import os
from array import array
from pathlib import Path
from typing import Any

import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.launch.offline import slices
from sparseskin.launch.offline.plan import Stamps, plan_slices
from sparseskin.launch.offline.scenarios import Scenario, record_scenario
from sparseskin.launch.offline.slices import PARTS_SUFFIX
from sparseskin.messages import Message, Reconstruction, decode
from sparseskin.nodes.recorder.bag.reader import BagReader

N_FRAMES = 40
#: A solver that is soon set up, but carries its last frame on to the next.
SOON = ("--set", "reconstructor.preset=paper")
#: A warm-up that begins with the recording: every slice then does all that one pass does.
ALL = ("--warm-up", "1000")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "box.mcap"
    record_scenario("box", Scenario("lift_box_40", 320, N_FRAMES, 8, "a cube lands"), path)
    return path


@pytest.fixture(scope="module")
def one_pass(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("one_pass") / "one.mcap"
    summary = str(out.with_suffix(".json"))
    more = ("--summary", summary, *SOON)
    assert main(["reprocess", str(recording), "--out", str(out), *more]) == 0
    return out


def messages(path: Path) -> list[Message]:
    """All messages in recorded order, without the time that solvers took."""
    with BagReader(path) as bag:
        assert bag.recovered == ""
        found = [decode(m.topic.encode(), m.payload) for m in bag.messages()]
    return [m.__class__(**{**vars(m), "solve_ns": (0,)}) if isinstance(m, Reconstruction) else m
            for m in found]  # fmt: skip


def as_text(path: Path) -> list[str]:
    return [repr(sorted((k, _plain(v)) for k, v in vars(m).items())) for m in messages(path)]


def _plain(value: Any) -> Any:
    return value.tobytes() if hasattr(value, "tobytes") else value


def stamps(path: Path) -> list[int]:
    return [m.stamp_ns for m in messages(path) if isinstance(m, Reconstruction)]


def sliced(recording: Path, out: Path, *more: str, seconds: str = "0.1") -> int:
    return main(["reprocess", str(recording), "--out", str(out), "--slices", seconds, *SOON, *more])


@pytest.mark.parametrize("start_from", ["measurements", "taxels"])
def test_with_a_warm_up_from_the_begin_slices_are_one_pass_bit_for_bit(
    recording: Path, one_pass: Path, tmp_path: Path, start_from: str
) -> None:
    out, summary = tmp_path / "out.mcap", tmp_path / "out.json"
    more = (*ALL, "--from", start_from, "--summary", str(summary))
    assert sliced(recording, out, *more) == 0
    assert as_text(out) == as_text(one_pass)
    (mine,) = json.loads(summary.read_text())["recordings"].values()
    (theirs,) = json.loads(one_pass.with_suffix(".json").read_text())["recordings"].values()
    for found in (mine, theirs):
        del found["patches"]["skin"]["solve_ms"]
    # Sums of floating-point numbers, in another order.
    assert flat(mine) == pytest.approx(flat(theirs))
    assert not (tmp_path / f"out.mcap{PARTS_SUFFIX}").exists()


def test_the_default_solver_is_the_same_in_slices_with_rotating_rows(
    recording: Path, tmp_path: Path
) -> None:
    whole, out = tmp_path / "whole.mcap", tmp_path / "out.mcap"
    settings = ("--set", "reconstructor.preset=skin", "--set", "compressor.ratio=5")
    assert main(["reprocess", str(recording), "--out", str(whole), *settings]) == 0
    assert sliced(recording, out, *ALL, *settings, seconds="0.23") == 0
    assert as_text(out) == as_text(whole)


def flat(value: Any) -> Any:
    """Numbers of a nested document in order, other values as texts."""
    if isinstance(value, dict):
        return [one for key in sorted(value) for one in flat(value[key])]
    if isinstance(value, list):
        return [one for each in value for one in flat(each)]
    return [value if isinstance(value, float | int) else hash(str(value)) % 1000]


def test_with_a_short_warm_up_each_frame_is_there_once_in_order(
    recording: Path, one_pass: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    assert sliced(recording, out, "--warm-up", "4", "--from", "taxels") == 0
    found = stamps(out)
    assert found == sorted(set(found)) == stamps(one_pass)
    seqs = [m.seq for m in messages(out) if isinstance(m, Reconstruction)]
    assert seqs == list(range(len(found)))
    printed = capsys.readouterr().out
    assert f"4 slices, {N_FRAMES} frames" in printed
    assert "3 seams: RMS difference" in printed
    assert "minutes a GB (the field: 5)" in printed


class StopError(Exception):
    """Stands for whatever ends a run."""


def interrupt(recording: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Reprocess until two slices are done; return their files."""
    real, done = slices.run_slice, []

    def run(task: slices.Task) -> str:
        if len(done) == 2:
            raise StopError
        done.append(real(task))
        return done[-1]

    with monkeypatch.context() as patch:
        patch.setattr(slices, "run_slice", run)
        assert sliced(recording, out, *ALL) == 2
    assert not out.exists()
    return [Path(f"{out}{PARTS_SUFFIX}") / name for name in done]


@pytest.mark.parametrize("change", ["", "flipped", "torn", "gone"])
def test_a_second_call_continues_with_the_parts_that_are_as_they_were_written(
    recording: Path,
    one_pass: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    change: str,
) -> None:
    out = tmp_path / "out.mcap"
    first, _ = interrupt(recording, out, monkeypatch)
    capsys.readouterr()
    data = bytearray(first.read_bytes())
    if change == "flipped":
        data[len(data) // 2] ^= 1
        first.write_bytes(data)
    elif change == "torn":
        first.write_bytes(data[:-100])
    elif change == "gone":
        first.unlink()
    assert sliced(recording, out, *ALL) == 0
    captured = capsys.readouterr()
    named = change in ("flipped", "torn")
    assert captured.err.count("\n") == captured.err.count(str(first)) == named
    assert f"{1 if change else 2} slices known from an earlier run" in captured.out
    assert as_text(out) == as_text(one_pass)


def test_parts_of_other_settings_are_not_used_and_removed(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    out = tmp_path / "out.mcap"
    interrupt(recording, out, monkeypatch)
    assert sliced(recording, out, *ALL, "--set", "reconstructor.iterations=5") == 0
    assert "known from an earlier run" not in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]


def test_a_folder_of_parts_that_others_can_enter_is_refused(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    folder = tmp_path / f"out.mcap{PARTS_SUFFIX}"
    folder.mkdir()
    os.chmod(folder, 0o755)
    assert sliced(recording, out) == 2
    assert "lets other users in" in capsys.readouterr().err


def test_slices_cover_each_frame_once_and_begin_with_the_first_row_subset() -> None:
    frames = array("q", [10 * k for k in range(50)])
    # Three row subsets, from frame 20 on five.
    found = plan_slices(Stamps(frames, {}, [(0, 3), (20, 5)]), 100e-9, 4)
    assert [one.n_before for one in found] == [0, 10, 20, 30, 40]
    assert [one.n_frames for one in found] == [10] * 5
    assert [one.first_ns for one in found[1:]] == [one.stop_ns for one in found[:-1]]
    assert found[-1].stop_ns is None
    # 6 and 15 are multiples of 3; 25 and 35 are 20 and a multiple of 5.
    assert [one.begin_ns // 10 for one in found] == [0, 6, 15, 25, 35]
    assert [one.n_warm_up for one in found] == [0, 4, 5, 5, 5]


def test_recordings_at_addresses_are_read_and_written(
    recording: Path, one_pass: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fsspec = pytest.importorskip("fsspec")
    source, out = "memory://in/box.mcap", "memory://out/out.mcap"
    store = fsspec.filesystem("memory")
    store.put_file(str(recording), source)
    assert main(["bag", "info", source]) == 0
    assert source in capsys.readouterr().out
    options = ("--slices", "0.1", *SOON, *ALL)
    assert main(["reprocess", source, "--out", out, *options]) == 2
    assert "state --parts" in capsys.readouterr().err
    parts = ("--parts", str(tmp_path / "parts"))
    assert main(["reprocess", source, "--out", out, *options, *parts]) == 0
    store.get_file(out, str(tmp_path / "out.mcap"))
    assert as_text(tmp_path / "out.mcap") == as_text(one_pass)
    capsys.readouterr()
    for target, text in ((out, "exists already"), ("s4://o/o.mcap", "protocol 's4'")):
        assert main(["reprocess", source, "--out", target, *SOON]) == 2
        captured = capsys.readouterr()
        assert text in captured.err
        assert captured.err.count("\n") == 1
    store.store.clear()
