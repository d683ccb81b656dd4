"""Evaluation of solvers: the same frames for all, errors against closed forms."""

import numpy as np
import pytest

from sparseskin.messages.skin import Skin
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.studies.evaluate import Reading, evaluate, make_method, phis_at

SHAPE = (8, 8)
TRUTHS = [np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.float32)]
TRUTHS[1][2:4, 2:4] = 1.0
FRAMES = [(truth, truth + np.float32(0.02)) for truth in TRUTHS]


def test_a_reading_is_scored_against_the_closed_form():
    scores = evaluate({"raw": Reading(), "zone": Reading(0.1)}, FRAMES)
    raw, zone = scores["raw"], scores["zone"]
    every_db = 20 * np.log10(2.5 / 0.02)
    assert raw.psnr_db == pytest.approx([every_db, every_db], abs=1e-4)
    assert raw.contact == [False, True]
    assert raw.contact_db == raw.psnr_db[1:]
    assert raw.touched == [(pytest.approx(0.02**2, rel=1e-4), 4)]
    # 4 of 64 taxels are off: 12 dB more.
    assert zone.psnr_db == pytest.approx([100.0, every_db + 20 * np.log10(4)], abs=1e-4)


def test_a_method_is_the_solver_on_its_own_measurements():
    chosen = {"solver": "fista", "iterations": 5, "lambda_n": 0.01}
    method = make_method(chosen, SHAPE, 2, seed=3, rows=FIXED)
    phi = make_phi("sbhe", n=64, m=32, seed=3)
    solver = make_solver("fista", phi, make_basis("haar", *SHAPE), iterations=5, lambda_n=0.01)
    scores = evaluate({"fista": method}, FRAMES)["fista"]
    expected = [solver.solve(phi.forward(taxels.reshape(-1))) for _, taxels in FRAMES]
    errors = [psnr_db(forces - truth, 2.5) for forces, truth in zip(expected, TRUTHS, strict=True)]
    assert scores.psnr_db == errors
    assert scores.n_steps == [5, 5]
    assert all(wall_s > 0 for wall_s in scores.wall_s)
    method.reset()
    np.testing.assert_array_equal(method.reconstruct(FRAMES[0][1]).forces, expected[0])


def test_rotating_row_subsets_together_hold_every_row():
    phis = phis_at(Skin(8, 8, 2.5), 3, ROTATING, seed=0)
    assert [phi.m for phi in phis] == [22, 22, 22]
    method = make_method(PRESETS["skin"], SHAPE, 3, seed=0, rows=ROTATING)
    used = []
    for _, taxels in [*FRAMES, *FRAMES]:
        used.append(method.phi.fingerprint)
        np.testing.assert_array_equal(
            method.measure(taxels), method.phi.forward(taxels.reshape(-1))
        )
        method.reconstruct(taxels)
    assert len(set(used[:3])) == 3
    assert used[3] == used[0]


def test_missing_taxels_are_not_measured():
    mask = np.ones(SHAPE, np.bool_)
    mask[0] = False
    method = make_method(PRESETS["paper"], SHAPE, 2, seed=0, rows=FIXED, mask=mask)
    taxels = FRAMES[1][1].copy()
    taxels[0] = np.nan
    assert not method.reconstruct(taxels).forces[0].any()
