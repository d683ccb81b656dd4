"""The study `latency`: its arithmetic by hand, and one short graph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sparseskin.studies import looped
from sparseskin.studies.evaluate import in_contact
from sparseskin.studies.latency import study as latency
from sparseskin.studies.latency.study import (
    QUANTILES,
    SCENES,
    STAGES,
    figures,
    measure,
    stages_ns,
)
from sparseskin.studies.scene_frames import scene_frames


def test_the_stages_of_a_frame_add_up_to_its_age() -> None:
    # Two frames 1000 ns apart; the second finds edge and host busy with the first.
    sensor = np.array([[0, 100], [1000, 110]])
    edge = np.array([[0, 150, 1300], [1000, 320, 400]])
    host = np.array([[0, 1400, 1450, 1700, 1800], [1000, 850, 900, 1500, 1510]])
    first, second = stages_ns(sensor, edge, host).tolist()
    assert first == [100, 50, 0, 1150, 100, 0, 50, 250]
    # The edge was free 300 ns after the stamp of the second frame, 190 after it had been sent.
    # The host was free 800 ns after it, 400 after the measurements had been sent.
    assert second == [110, 20, 190, 80, 50, 400, 50, 600]
    assert [sum(first), sum(second)] == [1700, 1500]


@pytest.mark.parametrize("scene", SCENES.values())
def test_the_skin_is_touched_in_the_frames_that_are_timed(scene: str) -> None:
    source = getattr(looped, scene)
    _, first, n, _ = source.args
    assert source.args[0] == scene
    frames = scene_frames(scene, 0, first, first + n, n // 8)
    assert all(in_contact(truth, 2.5) for truth, _ in frames)


def test_frames_that_are_lost_on_the_way_are_left_out() -> None:
    sensor = np.array([[k, 10] for k in range(0, 5000, 1000)])
    edge = np.array([[k, 20, 30] for k in range(0, 5000, 1000)])
    host = np.array([[k, 40, 50, 60, 70] for k in (0, 1000, 4000)])
    assert stages_ns(sensor, edge, host).shape == (3, len(STAGES))


def test_a_reader_that_was_free_made_nothing_wait() -> None:
    sensor = np.array([[0, 10], [1000, 10]])
    edge = np.array([[0, 20, 30], [1000, 500, 510]])
    host = np.array([[0, 40, 50, 60, 70], [1000, 600, 610, 620, 630]])
    assert stages_ns(sensor, edge, host)[:, [2, 5]].tolist() == [[0, 0], [0, 0]]


def test_quantiles_and_the_stages_around_them() -> None:
    rng = np.random.default_rng(1)
    stages = rng.uniform(0, 1, (4000, len(STAGES)))
    found = figures(stages)
    total = stages.sum(axis=1)
    for name, q in QUANTILES.items():
        assert found[name]["total_ms"] == round(float(np.quantile(total, q)), 4)
        # What the stages around a quantile add up to is that quantile, nearly.
        assert abs(sum(found[name]["stages_ms"]) - found[name]["total_ms"]) < 0.1


def test_a_graph_with_a_stopwatch_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latency, "WARM_UP", 20)
    point = {"scene": "path_40", "preset": "skin", "depth": 0, "rate_hz": 100, "n_frames": 150}
    point |= {"monitor": False}
    found = measure(point)
    assert found["lost"] == found["skipped"] == 0
    assert found["n_frames"] == 130
    for name in QUANTILES:
        assert found[name]["total_ms"] > 0
        # A stage by itself may be negative: a process can be suspended between sending and noting.
        assert len(found[name]["stages_ms"]) == len(STAGES)
    row = latency.row_of(point, found)
    assert "latency.png" in latency.draw(tmp_path, pd.DataFrame([row, row]))
    assert (tmp_path / "latency.svg").stat().st_size > 1000
