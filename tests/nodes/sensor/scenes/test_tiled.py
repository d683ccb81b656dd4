"""Scenes of a body: which patches are pressed, when, and with what force."""

import numpy as np
import pytest

from sparseskin.messages.skin import CONTACT_FRACTION, PAPER_F_MAX_N, Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.scenes.tiled import TILED, TiledScene

SKIN = Skin(12, 16, PAPER_F_MAX_N, pitch_m=0.005)
STEP_S = 0.05


def touched(scene, seconds):
    """True where a patch is touched, (n_frames, n_patches)."""
    frames = [scene.forces(k * STEP_S) for k in range(round(seconds / STEP_S))]
    return np.array([f.max(axis=(1, 2)) > CONTACT_FRACTION * PAPER_F_MAX_N for f in frames])


@pytest.mark.parametrize("name", TILED)
def test_as_many_patches_are_pressed_as_stated_and_the_others_are_idle(name):
    ever = touched(TiledScene(name, SKIN, 20), TILED[name].period_s).any(axis=0)
    assert np.count_nonzero(ever) == np.ceil(TILED[name].active * 20)


@pytest.mark.parametrize("name", TILED)
@pytest.mark.parametrize("shape", [(16, 5), (1, 16)])
def test_forces_are_within_the_range_and_each_press_ends(name, shape):
    scene = TiledScene(name, Skin(*shape, PAPER_F_MAX_N, pitch_m=0.005), 3, active=0.3)
    peaks = [scene.forces(k * STEP_S).max() for k in range(round(TILED[name].period_s / STEP_S))]
    assert 0.1 < max(peaks) < 0.9
    assert scene.forces(TILED[name].pressed_s + 1e-6)[0].max() == 0.0


def test_left_and_right_soles_alternate():
    pressed = touched(TiledScene("walk", SKIN, 8), 4 * TILED["walk"].period_s)
    left, right = pressed[:, 0], pressed[:, 1]
    assert not pressed[:, 2:].any()
    half = round(TILED["walk"].period_s / 2 / STEP_S)
    np.testing.assert_array_equal(left[:-half], right[half:])
    assert left.any()
    assert not left.all()


def test_a_body_that_lies_turns_to_other_patches():
    pressed = touched(TiledScene("lying", SKIN, 6), 2 * TILED["lying"].period_s)
    first, second = np.array_split(pressed, 2)
    np.testing.assert_array_equal(first.any(axis=0), ~second.any(axis=0))


def test_the_settled_force_bears_the_weight_of_the_body():
    scene = TiledScene("hug", SKIN, 1)
    body = TILED["hug"].body(SKIN.shape, 0.005)
    total = float(scene.forces(2.2)[0].sum(dtype=np.float64))
    assert total == pytest.approx(9.81 * body.mass_kg, rel=0.02)


def test_patches_differ_by_mirroring_alone():
    forces = TiledScene("hug", SKIN, 4, active=1.0).forces(2.2)
    for other, mirrored in ((1, forces[0, ::-1]), (3, forces[0, ::-1, ::-1])):
        np.testing.assert_allclose(forces[other], mirrored, rtol=1e-3)


def test_a_skin_without_pitch_is_refused():
    with pytest.raises(SourceError, match="pitch"):
        TiledScene("hug", Skin(4, 4, 2.5), 4)
