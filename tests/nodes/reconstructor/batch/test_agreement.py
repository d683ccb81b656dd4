"""The batch solver computes what `SkinSolver` does, for each of its patches, on each library."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
from patch_streams import Solved, Stream, batched, one_by_one, stream
from pressed import psnr_db

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.reconstructor.batch.backend import Backend
from sparseskin.nodes.reconstructor.batch.graphs import MODES

#: Newtons. Rounding is amplified by the iterations; noise is 0.03 N.
ROUNDING = 1e-3


def assert_agree(mine: Solved, other: Solved, within: float = ROUNDING) -> None:
    """Forces agree, and so do models and trust, in all frames."""
    np.testing.assert_allclose(mine.forces, other.forces, rtol=0, atol=within)
    np.testing.assert_array_equal(mine.decisions[:, 1:], other.decisions[:, 1:])
    np.testing.assert_allclose(mine.errors, other.errors, rtol=1e-3, atol=within)


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
@pytest.mark.parametrize("ratio", [3, 8])
@pytest.mark.parametrize(("body", "side"), [("wrench", 32), ("fingertips", 40)])
def test_psnr_is_that_of_the_default_solver(body: str, side: int, ratio: int, rows: str) -> None:
    known = stream(body, ratio, rows, shape=(side, side))
    (mine,), other = batched([known]), one_by_one(known)
    truth = np.array(known.truth)
    touched = truth.max(axis=(1, 2)) > 0
    assert touched.sum() >= 25
    found_db = [psnr_db(one.forces[touched], truth[touched]) for one in (mine, other)]
    if ratio == 3:
        assert found_db[0] == pytest.approx(found_db[1], abs=0.1)
        assert np.mean(mine.decisions[:, 1] == other.decisions[:, 1]) >= 0.9
        assert np.mean(mine.decisions[:, 2] == other.decisions[:, 2]) >= 0.9
    else:
        # The smooth model, which N/8 needs, amplifies rounding up to decisions: the two forms
        # differ as the default solver does between kernels of BLAS.
        assert found_db[0] == pytest.approx(found_db[1], abs=2)


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
@pytest.mark.parametrize("body", ["wrench", "peg"])
def test_forces_and_decisions_are_those_of_the_default_solver(body: str, rows: str) -> None:
    known = stream(body, 3, rows)
    assert_agree(batched([known])[0], one_by_one(known))


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
def test_frames_that_were_read_twice_agree(rows: str) -> None:
    known = stream("peg", 3, rows)
    period = len(known.phis)
    rounds = [range(k, k + period) for k in range(0, len(known.y) - period + 1, period)]
    order = [k for frames in rounds for k in (*frames, *frames)]
    twice = known._replace(y=[known.y[k] for k in order], truth=[known.truth[k] for k in order])
    assert_agree(batched([twice])[0], one_by_one(twice))


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
def test_both_models_and_their_trial_are_those_of_the_default_solver(rows: str) -> None:
    known = stream("gaussian", 3, rows, active=0.5, shape=(24, 20), n_frames=24)
    (mine,), other = batched([known]), one_by_one(known)
    assert 0 < mine.decisions[:, 1].sum() < len(known.y)
    np.testing.assert_array_equal(mine.decisions[:, 1:], other.decisions[:, 1:])
    np.testing.assert_allclose(mine.forces, other.forces, rtol=0, atol=0.05)


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
def test_taxels_that_do_not_exist_are_zero_and_change_nothing(rows: str) -> None:
    known = stream("peg", 3, rows, shape=(24, 22), n_frames=24, holes=True)
    (mine,) = batched([known])
    assert not mine.forces[:, ~known.mask].any()
    assert mine.forces[-1].max() > 0.1
    assert_agree(mine, one_by_one(known))


def test_all_taxels_measured_are_solved_without_an_estimate_of_the_error() -> None:
    known = stream("peg", 1, "fixed", shape=(16, 16), n_frames=16)
    (mine,) = batched([known])
    assert np.isnan(mine.errors).all()
    assert mine.decisions[:, 2].all()
    assert_agree(mine, one_by_one(known))


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
def test_a_patch_in_a_batch_is_solved_as_it_is_alone(rows: str) -> None:
    streams = [
        stream(body, 3, rows, seed=seed, n_frames=24, active=active)
        for body, seed, active in (("wrench", 0, 0.1), ("peg", 1, 0.1), ("gaussian", 2, 0.3))
    ]
    for mine, known in zip(batched(streams), streams, strict=True):
        (alone,) = batched([known])
        # Products of matrices of other sizes round otherwise, which may turn a decision.
        apart = np.abs(mine.forces - alone.forces).max(axis=(1, 2))
        assert np.mean(apart < ROUNDING) >= 0.8
        assert np.mean((mine.decisions == alone.decisions).all(axis=1)) >= 0.8


def small() -> list[Stream]:
    """Two short streams with holes, one of them in need of the smooth model."""
    options = {"shape": (20, 16), "n_frames": 16, "holes": True}
    return [
        stream("peg", 3, "rotating", **options),  # type: ignore[arg-type]
        stream("gaussian", 3, "rotating", active=0.4, **options),  # type: ignore[arg-type]
    ]


@pytest.mark.parametrize("device", ["strict", "cpu"])
def test_another_array_library_gives_the_same(device: str) -> None:
    if device == "cpu" and find_spec("torch") is None:
        pytest.skip("torch is not installed")
    for mine, other in zip(batched(small(), device), batched(small()), strict=True):
        np.testing.assert_array_equal(mine.decisions, other.decisions)
        np.testing.assert_allclose(mine.forces, other.forces, rtol=0, atol=0.05)


@pytest.mark.parametrize("mode", MODES[:-1])
def test_a_gpu_gives_the_same(mode: str) -> None:
    try:
        Backend("cuda")
    except SettingsError as error:
        pytest.skip(str(error))
    streams = [stream("peg", 3, "fixed"), stream("wrench", 3, "fixed")]
    for mine, other in zip(batched(streams, "cuda", mode), batched(streams), strict=True):
        assert_agree(mine, other)
