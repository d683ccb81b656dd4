"""Compiled searches for faults find what those in numpy find, frame by frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.faults.rows import RowWatch
from sparseskin.nodes.reconstructor.faults.taxels import ALONE, INSIDE, EndWatch, TaxelWatch

pytest.importorskip("numba")
N, M = 256, 85


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("unfitted", [None, np.arange(3, M, 9)])
def test_rows_are_judged_as_in_numpy(seed: int, unfitted: Any) -> None:
    rng = np.random.default_rng(seed)
    phi = make_phi("sbhe", N, M, seed=seed)
    slow, fast = RowWatch(phi), RowWatch(phi, compiled=True)
    bad = rng.choice(M, 3, replace=False)
    found = 0
    for k in range(120):
        y = rng.normal(0, 0.01, M).astype(np.float32) + 0.02 * phi.forward(np.ones(N, np.float32))
        fitted = rng.normal(0, 0.004, M).astype(np.float32)
        if 20 <= k < 90:
            y[bad[0]], y[bad[1]] = 0.0, rng.normal(0, 2)
        if k >= 40:
            y[bad[2]] = 0.25  # constant
        changed = slow.update(y, fitted, unfitted)
        assert fast.update(y, fitted, unfitted) == changed
        found += changed
        np.testing.assert_array_equal(fast.left_out, slow.left_out)
        np.testing.assert_allclose(fast._evidence, slow._evidence, rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(fast._bound, slow._bound, rtol=1e-4)
        assert (fast._lively, fast._suspects) == (slow._lively, slow._suspects)
    assert found


def test_coarsely_quantised_rows_are_not_constant() -> None:
    phi = make_phi("sbhe", N, M, seed=0)
    fast = RowWatch(phi, compiled=True)
    rng = np.random.default_rng(0)
    for _ in range(60):
        y = rng.normal(0, 0.3, M).astype(np.float32)
        fast.update(quantised(y, 3), np.zeros(M, np.float32))
    assert not fast.left_out.any()


def images(draw: Any) -> tuple[Floats, Mask]:
    shape = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    rng = np.random.default_rng(draw(st.integers(0, 999)))
    levels = np.array([0, 0.05, 0.1, 0.2, 0.5, 2.5], np.float32)
    mask = rng.random(shape) < draw(st.sampled_from([0.5, 0.9, 1.1]))
    forces = np.where(mask, rng.choice(levels, shape, p=[0.1, 0.1, 0.1, 0.2, 0.4, 0.1]), 0)
    return forces.astype(np.float32), mask


@settings(max_examples=60)
@given(st.composite(images)())
def test_taxels_that_stand_alone_and_holes_are_the_same(image: tuple[Floats, Mask]) -> None:
    forces, mask = image
    skin = (mask, 2.5, 0.0628, 0.0141, print)
    slow, fast = TaxelWatch(*skin), TaxelWatch(*skin, compiled=True)
    assert fast._alone(forces) == slow._alone(forces)
    ends = [EndWatch(mask, 2.5), EndWatch(mask, 2.5, fast._loops)]
    dead: set[int] = set()
    for _ in range(2):
        assert ends[1].look(forces, dead) == ends[0].look(forces, dead)
        assert ends[1]._low == ends[0]._low
        assert ends[1]._alive == ends[0]._alive
        dead = {int(place) for place in np.flatnonzero(mask)[:3]}


def test_a_lone_taxel_and_a_hole_are_found() -> None:
    mask = np.ones((6, 6), np.bool_)
    forces = np.ones((6, 6), np.float32)
    forces[2, 3] = 0
    watch = TaxelWatch(mask, 2.5, 0.0628, 0.0141, print, compiled=True)
    inside, places = np.zeros((6, 6), np.bool_), np.zeros(36, np.int64)
    assert watch._loops.holes(forces, mask, 0.1, INSIDE, inside, places) == 1
    assert places[0] == 2 * 6 + 3
    np.testing.assert_array_equal(np.argwhere(inside)[[0, -1]], [[1, 1], [4, 4]])
    assert watch._alone(1 - forces) == {15}
    assert watch._loops.lone_taxels(forces, mask, 0.2, ALONE, places) == 0
