"""Stuck taxels are found and left out; sharp contacts are not taken for them."""

import numpy as np
import pytest
from watched import NOISE, Skin, pad
from watched import SKIN_SHAPE as SHAPE

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.reconstructor.faults.taxels import MEASURED, TaxelWatch
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
    assert skin.watch.text == "stuck taxels left out: (9, 12)"
    assert skin.watch.cells == [9 * 28 + 12]
    assert forces[9, 12] < 0.05
    assert len(skin.lines) == 1
    for _ in range(100):
        skin.read(nothing)
    assert not skin.watch.stuck
    assert skin.watch.cells == []
    assert skin.lines[-1] == "taxel (9, 12) works again: used"


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
