"""Stuck, dead and saturated taxels are found; sharp contacts and holes are not taken for them."""

import numpy as np
import pytest
from watched import NOISE, Skin, pad
from watched import SKIN_SHAPE as SHAPE

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.reconstructor.faults.taxels import (
    BELIEVED,
    ENOUGH,
    EVERY,
    FULL_LOOKS,
    MEASURED,
    EndWatch,
    TaxelWatch,
)
from sparseskin.nodes.sensor.noise import NoiseModel

N = 784
FRAMES = MEASURED + 60


@pytest.fixture(scope="module")
def phi():
    return make_phi("sbhe", N, N // 3, seed=0)


def test_a_stuck_taxel_is_found_left_out_and_used_when_it_works_again(phi):
    skin, nothing = Skin(phi), pad()
    for _ in range(FRAMES):
        forces = skin.read(nothing, {(9, 12): 1.3})
    assert list(skin.watch.stuck) == [9 * 28 + 12]
    assert (skin.watch.text, skin.watch.cells) == ("stuck taxels left out: (9, 12)", [9 * 28 + 12])
    assert forces[9, 12] < 0.05
    assert len(skin.lines) == 1
    for _ in range(100):
        skin.read(nothing)
    assert not skin.watch.stuck
    assert (skin.watch.cells, skin.lines[-1]) == ([], "taxel (9, 12) works again: used")


RING = pad((slice(8, 20), slice(8, 20))) - pad((slice(13, 14), slice(14, 15)))
QUIET = NoiseModel(2.5, 0.006, 0.0014)


def pegs(force):
    """A peg of one taxel, and an edge."""
    return pad((slice(5, 6), slice(5, 6)), (slice(20, 21), slice(3, 22)), force=force)


@pytest.mark.parametrize(
    ("truth", "noise"), [(pegs(0.3), NOISE), (pegs(2.0), NOISE), (RING, NOISE), (pegs(1.3), QUIET)]
)
def test_what_rests_for_long_or_is_quieter_than_stated_is_a_contact(phi, truth, noise):
    skin = Skin(phi, noise)
    for _ in range(2 * FRAMES):
        skin.read(truth)
    assert skin.lines == []


def test_what_is_left_out_is_the_mean_of_the_neighbours_that_work(phi):
    watch = TaxelWatch(np.ones(SHAPE, np.bool_), NOISE, print)
    watch.stuck = {0: 1.0, 29: 1.0, 30: 1.5}
    forces = np.arange(N, dtype=np.float32).reshape(SHAPE)
    filled = watch.filled(forces)
    assert filled[0, 0] == np.mean([1, 28])
    assert filled[1, 2] == pytest.approx(np.mean([1, 2, 3, 31, 57, 58, 59]))
    y = phi.forward(forces.reshape(-1))
    without = forces.copy()
    without.reshape(-1)[[0, 29, 30]] -= [1.0, 1.0, 1.5]
    np.testing.assert_allclose(watch.cleaned(phi, y), phi.forward(without.reshape(-1)), atol=1e-3)


@pytest.mark.parametrize("works", [True, False])
def test_a_column_that_stands_alone_is_suspected_at_once_until_its_noise_is_known(phi, works):
    skin, column = Skin(phi), pad((slice(None), slice(9, 10)), force=2.0)
    readings = {} if works else {(row, 9): 2.0 for row in range(SHAPE[0])}
    suspected = []
    for _ in range(80):
        skin.read(column if works else pad(), readings)
        suspected.append(skin.watch.doubts)
    assert all(suspected[10:40])
    assert not suspected[-1]
    assert bool(skin.watch.stuck) != works


def watch():
    return EndWatch(np.ones(SHAPE, np.bool_), 2.5)


def block(row, col):
    """A square of 9 x 9 taxels around a place."""
    return pad((slice(row - 4, row + 5), slice(col - 4, col + 5)))


def holed(row, col):
    frame = block(row, col)
    frame[10, 14] = 0
    return frame


#: A square that passes over the dead taxel, three taxels and once more.
PASSED = [holed(10, col) for col in (11, 14, 17)]


def ring(col):
    """A square with a hole in its middle."""
    frame = block(10, col)
    frame[10, col] = 0
    return frame


def lying(end):
    """Pressed around the hole from column 10 up to this one."""
    frame = pad((slice(6, 15), slice(10, end)))
    frame[10, 14] = 0
    return frame


@pytest.mark.parametrize(
    ("frames", "n_looks"),
    [
        ([ring(col) for col in range(10, 18)], ENOUGH),  # the hole moves with its body
        ([holed(10, 13), holed(10, 14)] * 10 * ENOUGH, 1),  # it rests or rocks by a taxel
        ([lying(end) for end in (17, 23, 30)], 2 * ENOUGH),  # a body lies down around it
        ([2.5 * block(10, 14)], 2 * FULL_LOOKS),  # a contact at the end of the range
    ],
)
def test_what_a_body_may_do_is_no_fault(frames, n_looks):
    one = watch()
    for frame in frames:
        for _ in range(n_looks):
            assert one.look(frame, {}) == ([], [], [])


def test_a_taxel_that_is_pressed_between_is_alive():
    one = watch()
    for frame in PASSED:
        for _ in range(ENOUGH - 1):
            assert one.look(frame, {}) == ([], [], [])
        for _ in range(2):
            assert one.look(block(10, 14), {}) == ([], [], [])


def test_a_dead_taxel_is_logged_filled_in_and_used_again(phi):
    skin = Skin(phi)
    for col in (11, 14, 17):
        for _ in range(8 * EVERY):
            forces = skin.read(block(10, col), {(10, 14): 0.0})
    assert skin.watch.text == "dead taxels left out: (10, 14)"
    assert skin.lines == ["taxel (10, 14) reads 0 in every contact: left out"]
    assert forces[10, 14] == pytest.approx(1.0, abs=0.15)
    for _ in range((BELIEVED + 5) * EVERY):
        skin.read(block(10, 14))
    assert (skin.watch.text, skin.lines[1:]) == ("", ["taxel (10, 14) works again: used"])


def test_with_few_measurements_holes_in_reconstructions_are_no_evidence():
    skin = Skin(make_phi("sbhe", 784, 784 // 8, seed=0))
    for frame in PASSED:
        for _ in range(ENOUGH * EVERY):
            skin.watch.update(skin.phi, frame, np.zeros(skin.phi.m, np.float32))
    assert skin.lines == []


def test_a_saturated_taxel_is_found_on_an_untouched_skin(phi):
    skin = Skin(phi)
    for _ in range((FULL_LOOKS + 10) * EVERY):
        forces = skin.read(pad(), {(10, 14): 2.5})
    assert skin.lines == ["taxel (10, 14) is stuck at 2.5: left out"]
    assert forces[10, 14] < 0.05
