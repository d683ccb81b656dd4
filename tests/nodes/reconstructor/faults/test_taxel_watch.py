"""Stuck taxels are found and left out; sharp contacts are not taken for them."""

from __future__ import annotations

import numpy as np
import pytest
from watched import SKIN_SHAPE as SHAPE
from watched import Skin, pad

from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.reconstructor.faults.taxels import MEASURED, TaxelWatch
from sparseskin.nodes.sensor.noise import NoiseModel

N = 784
FRAMES = MEASURED + 60


@pytest.fixture(scope="module")
def phi() -> Phi:
    return make_phi("sbhe", N, N // 3, seed=0)


def test_a_stuck_taxel_is_found_left_out_and_used_when_it_works_again(phi: Phi) -> None:
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


@pytest.mark.parametrize("force", [0.3, 0.7, 1.3, 2.0])
def test_a_still_peg_of_one_taxel_and_a_still_edge_are_contacts(phi: Phi, force: float) -> None:
    skin = Skin(phi)
    truth = pad((slice(5, 6), slice(5, 6)), (slice(20, 21), slice(3, 22)), force=force)
    for _ in range(2 * FRAMES):
        skin.read(truth)
    assert skin.lines == []


def test_on_a_skin_that_is_quieter_than_stated_no_taxel_is_stuck(phi: Phi) -> None:
    skin = Skin(phi, NoiseModel(2.5, 0.006, 0.0014))
    for _ in range(2 * FRAMES):
        skin.read(pad((slice(5, 6), slice(5, 6)), force=1.3))
    assert skin.lines == []


def test_a_ring_that_rests_for_long_is_a_contact(phi: Phi) -> None:
    skin, ring = Skin(phi), pad((slice(8, 20), slice(8, 20)))
    ring[13, 14] = 0
    for _ in range(FRAMES):
        skin.read(ring)
    assert skin.lines == []


def test_what_is_left_out_is_the_mean_of_the_neighbours_that_work(phi: Phi) -> None:
    watch = TaxelWatch(np.ones(SHAPE, np.bool_), 2.5, 0.0628, 0.0141, print)
    watch.stuck = {0: 1.0, 29: 1.0, 30: 1.5}
    forces = np.arange(N, dtype=np.float32).reshape(SHAPE)
    filled = watch.filled(forces)
    assert filled[0, 0] == np.mean([1, 28])
    assert filled[1, 2] == pytest.approx(np.mean([1, 2, 3, 31, 57, 58, 59]))
    y = phi.forward(forces.reshape(-1))
    without = forces.copy()
    without.reshape(-1)[[0, 29, 30]] -= [1.0, 1.0, 1.5]
    np.testing.assert_allclose(watch.cleaned(phi, y), phi.forward(without.reshape(-1)), atol=1e-3)
