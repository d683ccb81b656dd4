"""Recordings on a Dask cluster, of which a worker or the scheduler ends."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from bags import record_scene
from conftest import PATIENCE_S, free_port
from dask_processes import Cluster

from sparseskin.launch.commands.cli import main
from sparseskin.messages import Reconstruction, decode
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.tasks import results
from sparseskin.plugins.cluster import dask as dask_cluster

pytest.importorskip("distributed")
NAMES = ("a.mcap", "b.mcap", "c.mcap")
SOON = ("--set", "reconstructor.preset=paper")


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    folder = tmp_path / "cluster"
    folder.mkdir()
    made = Cluster(folder)
    made.add_worker()
    yield made
    made.close()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("recordings")
    first = folder / NAMES[0]
    record_scene(first, "lift_box_40", 320, 40, 4)
    for name in NAMES[1:]:
        (folder / name).write_bytes(first.read_bytes())
    return [str(folder / name) for name in NAMES]


def after_first(monkeypatch: pytest.MonkeyPatch, act: Callable[[], Any]) -> None:
    """Let something happen when the first recording is done."""
    real = results.computed

    def computed(*arguments: Any) -> Iterator[Any]:
        for k, each in enumerate(real(*arguments)):
            yield each
            if k == 0:
                act()

    monkeypatch.setattr(results, "computed", computed)


def frames(path: Path) -> list[tuple[int, bytes]]:
    with BagReader(path) as bag:
        found = [decode(m.topic.encode(), m.payload) for m in bag.messages()]
    return [(m.stamp_ns, m.forces.tobytes()) for m in found if isinstance(m, Reconstruction)]


@pytest.mark.slow
def test_what_a_killed_worker_had_to_do_is_done_by_another(
    cluster: Cluster, recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def replace() -> None:
        cluster.workers[0].send_signal(signal.SIGKILL)
        cluster.workers[0].wait(PATIENCE_S)
        cluster.add_worker()

    after_first(monkeypatch, replace)
    out, one = tmp_path / "out", tmp_path / "one.mcap"
    where = f"dask:{cluster.address}"
    assert main(["reprocess", *recordings, "--out", str(out), *SOON, "--executor", where]) == 0
    assert main(["reprocess", recordings[0], "--out", str(one), *SOON]) == 0
    assert all(frames(out / name) == frames(one) for name in NAMES)


@pytest.mark.slow
def test_recordings_that_a_dead_scheduler_leaves_are_named_in_one_line_each(
    cluster: Cluster, recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    after_first(monkeypatch, cluster.close)
    out, where = tmp_path / "out", f"dask:{cluster.address}"
    assert main(["reprocess", *recordings, "--out", str(out), *SOON, "--executor", where]) == 2
    warning, *lines = capsys.readouterr().err.splitlines()
    assert "runs code here" in warning
    assert [line.partition(": ")[0] for line in lines] == recordings[1:]
    assert [path.name for path in out.glob("*.mcap")] == [NAMES[0]]


def test_a_scheduler_that_does_not_answer_is_one_line(
    recordings: list[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(dask_cluster, "CONNECT_S", 0.2)
    where = f"dask:tcp://127.0.0.1:{free_port()}"
    arguments = ["reprocess", recordings[0], "--out", str(tmp_path / "o.mcap")]
    assert main([*arguments, "--executor", where]) == 2
    warning, line = capsys.readouterr().err.splitlines()
    assert "runs code here" in warning
    assert line.startswith(f"--executor {where}: no Dask scheduler answers")
