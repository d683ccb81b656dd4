"""Slices on a Dask cluster, of which a worker or the scheduler is killed."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import PATIENCE_S, free_port
from dask_processes import Cluster

from sparseskin.launch.commands.cli import main
from sparseskin.launch.offline import slices
from sparseskin.launch.offline.scenarios import Scenario, record_scenario
from sparseskin.launch.offline.slices import PARTS_SUFFIX
from sparseskin.messages import Reconstruction, decode
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.plugins.cluster import dask as dask_cluster

pytest.importorskip("distributed")


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    folder = tmp_path / "cluster"
    folder.mkdir()
    made = Cluster(folder)
    yield made
    made.close()


def frames(path: Path) -> list[tuple[int, bytes]]:
    with BagReader(path) as bag:
        found = [decode(m.topic.encode(), m.payload) for m in bag.messages()]
    return [(m.stamp_ns, m.forces.tobytes()) for m in found if isinstance(m, Reconstruction)]


@pytest.mark.slow
def test_a_worker_that_is_killed_in_the_middle_loses_nothing(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, whole, out = (tmp_path / f"{name}.mcap" for name in ("box", "whole", "out"))
    record_scenario("box", Scenario("lift_box_40", 320, 90, 4, "a cube lands"), recording)
    assert main(["reprocess", str(recording), "--out", str(whole)]) == 0
    for _ in range(2):
        cluster.add_worker()
    real, finished = slices.computed, []

    def computed(*arguments: Any) -> Iterator[Any]:
        for each in real(*arguments):
            yield each
            finished.append(each)
            if len(finished) != 3:
                continue
            # Whichever worker that is: both have slices under way or waiting.
            cluster.workers[0].send_signal(signal.SIGKILL)
            cluster.workers[0].wait(PATIENCE_S)

    monkeypatch.setattr(slices, "computed", computed)
    options = ("--slices", "0.1", "--warm-up", "1000", "--executor", f"dask:{cluster.address}")
    assert main(["reprocess", str(recording), "--out", str(out), *options]) == 0
    assert len(finished) == 9  # each slice once
    assert frames(out) == frames(whole)
    assert cluster.workers[0].poll() is not None
    assert cluster.workers[1].poll() is None
    assert not Path(f"{out}{PARTS_SUFFIX}").exists()


@pytest.mark.slow
def test_a_run_whose_scheduler_dies_ends_in_one_line_and_is_continued_elsewhere(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    recording, out = tmp_path / "box.mcap", tmp_path / "out.mcap"
    record_scenario("box", Scenario("lift_box_40", 320, 40, 4, "a cube lands"), recording)
    cluster.add_worker()
    real, finished = slices.computed, []

    def computed(*arguments: Any) -> Iterator[Any]:
        for each in real(*arguments):
            yield each
            finished.append(each)
            if len(finished) == 1:
                cluster.close()

    options = ("--slices", "0.1", "--set", "reconstructor.preset=paper")
    with monkeypatch.context() as patch:
        patch.setattr(slices, "computed", computed)
        where = f"dask:{cluster.address}"
        assert main(["reprocess", str(recording), "--out", str(out), *options,
                     "--executor", where]) == 2  # fmt: skip
    assert capsys.readouterr().err.count("\n") == 1
    assert list(Path(f"{out}{PARTS_SUFFIX}").glob("*.mcap"))
    assert main(["reprocess", str(recording), "--out", str(out), *options]) == 0
    assert "known from an earlier run" in capsys.readouterr().out
    assert len(frames(out)) == 40


def test_a_scheduler_that_does_not_answer_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(dask_cluster, "CONNECT_S", 0.2)
    recording = tmp_path / "box.mcap"
    record_scenario("box", Scenario("lift_box_40", 320, 4, 1, ""), recording)
    where = f"dask:tcp://127.0.0.1:{free_port()}"
    arguments = ["reprocess", str(recording), "--out", str(tmp_path / "o.mcap")]
    assert main([*arguments, "--executor", where]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"--executor {where}: no Dask scheduler answers")
    assert err.count("\n") == 1
