"""The study of what scenes need: its variants, its figures, its verdicts."""

import numpy as np
import pytest

from sparseskin.nodes.sensor.scenes.scenes import SCENES, open_scene
from sparseskin.studies.needs import Variant, measure, variants, verdict


def compared(scene, variant, n_steps=420):
    return measure({"scene": scene, "variant": variant, "n_steps": n_steps, "seed": 0})


def test_a_scene_that_is_not_changed_gives_its_own_frames():
    ours = Variant(True, SCENES["lift_box_40"]()).frames()
    for (_, expected), frame in zip(open_scene("lift_box_40", 0), ours, strict=True):
        np.testing.assert_array_equal(frame, expected)


@pytest.mark.parametrize("name", SCENES)
def test_each_degree_of_freedom_and_each_term_is_taken_away_or_added(name):
    scene = SCENES[name]()
    found = variants(scene)
    assert found["pitch"].carried == ("pitch" in scene.dof)
    assert ("pitch" in found["pitch"].scene.dof) != found["pitch"].carried
    assert found["roll"].scene.dof != scene.dof
    assert found["damping of the skin"].scene.surface.damping == 0.0
    assert found["moving average"].smoothing_steps == 1
    grounded = scene.surface.ground_drop_m is not None
    assert found["ground"].carried == grounded
    assert (found["ground"].scene.surface.ground_drop_m is None) == grounded
    assert ("damping of the ground" in found) == grounded
    finer = found["steps a tenth as long"]
    assert finer.scene.n_steps * finer.scene.dt_ns == scene.n_steps * scene.dt_ns


def test_what_a_scene_carries_changes_its_frames_by_more_than_the_noise():
    for variant in ("damping of the skin", "moving average"):
        figures = compared("lift_box_40", variant)
        assert figures["carried"]
        assert figures["change_db"] < figures["noise_db"] - 3.0
        assert figures["worst_db"] < figures["change_db"]


def test_frames_do_not_hang_on_the_time_step():
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
    assert verdict({**row, "variant": variant, "scene": scene, "noise_db": 47.0}) == said
