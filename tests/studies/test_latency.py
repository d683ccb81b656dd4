"""Stages of a frame from acquisition to reconstruction: their arithmetic by hand."""

import numpy as np
import pytest

from sparseskin.nodes.touch import in_contact
from sparseskin.studies import looped
from sparseskin.studies.frames import scene_frames
from sparseskin.studies.speed.latency import QUANTILES, SCENES, STAGES, figures, stages_ns


def test_the_stages_of_a_frame_add_up_to_its_age():
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


def test_quantiles_and_the_stages_around_them():
    stages = np.random.default_rng(1).uniform(0, 1, (4000, len(STAGES)))
    found, total = figures(stages), stages.sum(axis=1)
    for name, q in QUANTILES.items():
        assert found[f"{name}_ms"] == round(float(np.quantile(total, q)), 4)
        # What the stages around a quantile add up to is that quantile, nearly.
        assert abs(sum(found[f"{name} {stage}"] for stage in STAGES) - found[f"{name}_ms"]) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES.values())
def test_the_skin_is_touched_in_the_frames_that_are_timed(scene):
    name, first, n, _ = getattr(looped, scene).args
    assert name == scene
    frames = scene_frames(scene, 0, first, first + n, n // 8)
    assert all(in_contact(truth, 2.5) for truth, _ in frames)
