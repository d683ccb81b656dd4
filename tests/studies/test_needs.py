"""What studies compute: needs of scenes, latencies, stability, constants of the default solver."""

import math

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize_scalar

from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.sensor.scenes.scenes import SCENES, open_scene
from sparseskin.nodes.touch import in_contact
from sparseskin.studies import looped
from sparseskin.studies.frames import scene_frames
from sparseskin.studies.needs import Variant, measure, verdict
from sparseskin.studies.paper.tables import FewLevelsHaarBasis
from sparseskin.studies.speed import latency
from sparseskin.studies.speed.latency import QUANTILES, STAGES, figures, stages_ns
from sparseskin.studies.stability.phase import weak_threshold
from sparseskin.studies.stability.sweeps import Sweep, failing


def compared(scene, variant, n_steps=420):
    return measure({"scene": scene, "variant": variant, "n_steps": n_steps, "seed": 0})


def test_a_scene_that_is_not_changed_gives_its_own_frames():
    ours = Variant(True, SCENES["lift_box_40"]()).frames()
    for (_, expected), frame in zip(open_scene("lift_box_40", 0), ours, strict=True):
        np.testing.assert_array_equal(frame, expected)


def test_what_a_scene_carries_changes_its_frames_and_the_time_step_does_not():
    for variant in ("damping of the skin", "moving average"):
        figures = compared("lift_box_40", variant)
        assert figures["carried"]
        assert figures["change_db"] < figures["noise_db"] - 3.0
        assert figures["worst_db"] < figures["change_db"]
    figures = compared("lift_wrench_40", "steps a tenth as long", n_steps=620)
    assert figures["change_db"] > figures["noise_db"] + 3.0


@pytest.mark.parametrize(
    ("carried", "change_db", "above", "variant", "scene", "said"),
    [
        (True, 40.0, 0.04, "pitch", "lift_wrench_40", "needed"),
        (True, 60.0, 0.04, "pitch", "lift_wrench_40", "superfluous"),
        (True, 60.0, 0.04, "round taxels", "lift_box_40", "kept"),
        (False, 60.0, 0.04, "roll", "lift_wrench_40", "rightly left out"),
        (False, 40.0, 0.04, "roll", "lift_wrench_40", "missing"),
        (False, 40.0, 0.04, "pitch", "path_40", "left out"),
    ],
)
def test_verdicts(carried, change_db, above, variant, scene, said):
    row = {"carried": carried, "change_db": change_db, "above_noise": above}
    assert (
        verdict({**row, "variant": variant, "scene": scene, "noise_db": 47.0}) == said
    )


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
    found = figures(stages)
    total = stages.sum(axis=1)
    for name, q in QUANTILES.items():
        assert found[f"{name}_ms"] == round(float(np.quantile(total, q)), 4)
        # What the stages around a quantile add up to is that quantile, nearly.
        assert (
            abs(sum(found[f"{name} {stage}"] for stage in STAGES) - found[f"{name}_ms"])
            < 0.1
        )


@pytest.mark.slow
@pytest.mark.parametrize("scene", latency.SCENES.values())
def test_the_skin_is_touched_in_the_frames_that_are_timed(scene):
    name, first, n, _ = getattr(looped, scene).args
    assert name == scene
    frames = scene_frames(scene, 0, first, first + n, n // 8)
    assert all(in_contact(truth, 2.5) for truth, _ in frames)


@pytest.mark.parametrize("delta", [0.1, 0.3, 0.5, 0.9])
def test_weak_threshold_is_where_the_cone_of_l1_has_as_many_dimensions_as_measurements(
    delta,
):
    # Amelunxen, Lotz, McCoy, Tropp (2014), Proposition 4.5, computed in its own way.
    share = weak_threshold(delta) * delta

    def dimension(tau):
        tail = quad(lambda u: (u - tau) ** 2 * math.exp(-u * u / 2), tau, tau + 12)[0]
        return share * (1 + tau**2) + (1 - share) * math.sqrt(2 / math.pi) * tail

    found = minimize_scalar(dimension, bounds=(0.0, 8.0), method="bounded")
    assert float(found.fun) == pytest.approx(delta, abs=2e-4)


def test_failing_is_said_on_both_sides_of_the_best_value():
    heights = {1: 40.0, 2: 44.0, 3: 45.0, 4: 43.0, 5: 41.9, 6: 30.0}
    rows = pd.DataFrame(
        {
            "value": v,
            "mean_db": h,
            "touched_db": 10.0,
            "noisy_mean_db": 40.0,
            "noisy_touched_db": 9,
        }
        for v, h in heights.items()
    )
    assert failing(rows, Sweep("")) == "≤ 1 and ≥ 5"
    assert failing(rows[1:4], Sweep("")) == "nowhere"
    assert failing(rows, Sweep("", against_readings=True)) == "≥ 6"


def test_it_stops_where_a_side_gets_odd_and_is_haar_where_none_does():
    for shape, n_left in (((40, 40), 5 * 5), ((40, 64), 5 * 8)):
        even = FewLevelsHaarBasis(*shape).analysis(np.ones(shape, np.float32))
        assert np.count_nonzero(np.abs(even) > 1e-4) == n_left
    image = np.random.default_rng(0).standard_normal((64, 64), dtype=np.float32)
    few = FewLevelsHaarBasis(64, 64)
    all_levels = HaarBasis(64, 64)
    np.testing.assert_allclose(
        few.analysis(image), all_levels.analysis(image), atol=1e-5
    )
