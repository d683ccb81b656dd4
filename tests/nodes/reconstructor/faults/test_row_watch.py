"""Faulty measurements are found, excluded and logged; working ones are not."""

from __future__ import annotations

import numpy as np
import pytest
from pressed import noisy, psnr_db, sliding_disc
from watched import DESK_SHAPE as SHAPE
from watched import Desk, N

from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.compressor.phi.base import RANDOM, Phi, make_phi
from sparseskin.nodes.compressor.phi.rotation import PAPER_BLOCK, row_subsets
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.faults.rows import CONSTANT, HEALED, RowWatch

M = 533
FAULTY = (3, 100, 250, 251, 400)
TOUCHED = slice(30, None)


@pytest.fixture(scope="module")
def truth() -> Floats:
    return sliding_disc(SHAPE, 80, touch_at=25)


@pytest.fixture(scope="module")
def phi() -> Phi:
    return make_phi("sbhe", N, M, seed=0)


def spoilt(y: Floats, fault: str) -> Floats:
    """Measurements with faulty ones from the first frame on."""
    rng = np.random.default_rng(1)
    wrong = {
        "zero": np.zeros((len(y), len(FAULTY))),
        "constant": np.tile(rng.uniform(0.3, 1, len(FAULTY)), (len(y), 1)),
        "garbage": rng.uniform(-2, 2, (len(y), len(FAULTY))),
    }[fault]
    y = y.copy()
    y[:, FAULTY] = wrong
    return y


@pytest.mark.parametrize("preset", ["skin", "paper"])
@pytest.mark.parametrize("fault", ["zero", "constant", "garbage"])
def test_faulty_measurements_are_found_and_cost_next_to_nothing_then(
    preset: str, fault: str, phi: Phi, truth: Floats
) -> None:
    if preset == "paper":
        phi = make_phi("sbhe", N, M, 0, PAPER_BLOCK, RANDOM)
    y = phi.forward(noisy(truth).reshape(-1, N))
    sound = psnr_db(Desk(phi, preset=preset).restore(y)[TOUCHED], truth[TOUCHED])
    bad = spoilt(y, fault)
    desk = Desk(phi, preset=preset)
    watched = psnr_db(desk.restore(bad)[TOUCHED], truth[TOUCHED])
    alone = psnr_db(
        Desk(phi, preset=preset, watch_rows=False).restore(bad)[TOUCHED], truth[TOUCHED]
    )
    assert watched > sound - 1.5
    assert alone < sound - 1.5
    assert "faulty measurements left out: " in desk.node.status()
    left_out = desk.node.state()["left_out"]
    assert set(FAULTY) <= set(map(int, left_out.partition("(")[2].rstrip(")").split(", ")))
    logged = [line for line in desk.lines if "left out" in line]
    assert sum(line.count(str(row)) for line in logged for row in (100, 250, 251, 400)) == 4


@pytest.mark.parametrize("preset", ["skin", "paper"])
@pytest.mark.parametrize("ratio", [3, 8])
def test_working_rows_are_never_left_out(preset: str, ratio: int, truth: Floats) -> None:
    phi = make_phi("sbhe", N, N // ratio, seed=0)
    desk = Desk(phi, preset=preset)
    desk.restore(phi.forward(noisy(truth).reshape(-1, N)))
    assert desk.node.state()["left_out"] == ""


@pytest.mark.parametrize("preset", ["skin", "paper"])
@pytest.mark.parametrize("everywhere", [True, False])
def test_of_rotating_rows_a_faulty_one_is_found_once_its_subset_was_read_as_often(
    preset: str, everywhere: bool, truth: Floats
) -> None:
    """The faulty measurements of one row subset, or the same ones of all (an input that fails)."""
    phi = make_phi("sbhe", N, M + 1, seed=0)
    subsets = row_subsets(phi, "rotating")
    readings = noisy(truth).reshape(-1, N)
    y = np.stack([subsets[k % 3].forward(one) for k, one in enumerate(readings)])
    desk = Desk(phi, rows="rotating", preset=preset)
    desk.restore(y)
    assert desk.node.state()["left_out"] == ""
    for subset in range(3):
        if everywhere or subset == 1:
            y[subset::3, FAULTY] = 0
    desk = Desk(phi, rows="rotating", preset=preset)
    desk.restore(y[: 3 * (CONSTANT - 1)])
    assert desk.node.state()["left_out"] == ""
    desk.restore(y[3 * (CONSTANT - 1) :])
    left_out = desk.node.state()["left_out"]
    listed = "5 of 534 of row subset {} (3, 100, 250, 251, 400)"
    found = [subset for subset in range(3) if listed.format(subset) in left_out]
    assert found == ([0, 1, 2] if everywhere else [1])
    assert left_out.count("of row subset") == len(found)


@pytest.mark.parametrize("bits", [6, 12, None])
def test_a_skin_without_noise_and_few_bits_have_no_faulty_measurements(
    bits: int | None, phi: Phi, truth: Floats
) -> None:
    desk = Desk(phi, preset="skin")
    for frames in (truth, noisy(truth)):
        y = phi.forward(frames.reshape(-1, N))
        for one in y:
            given = one if bits is None else quantised(one, bits)
            assert bits is None or isinstance(given, Quantised)
            desk.restore([given])  # type: ignore[arg-type]
        assert desk.node.state()["left_out"] == ""


def test_a_row_that_works_again_is_used_again_and_logged(phi: Phi) -> None:
    y = phi.forward(noisy(np.zeros((CONSTANT + 5, *SHAPE), np.float32)).reshape(-1, N))
    desk = Desk(phi, preset="skin")
    desk.restore(spoilt(y, "zero"))
    assert "5 of 533" in desk.node.status()
    for seed in range(1 + 2 * HEALED // len(y)):
        desk.restore(phi.forward(noisy(np.zeros((len(y), *SHAPE)), seed).reshape(-1, N)))
    assert desk.node.state()["left_out"] == ""
    again = ", ".join(line.partition("again: ")[2] for line in desk.lines if "again" in line)
    assert sorted(map(int, again.split(", "))) == list(FAULTY)


def test_a_row_that_fails_again_has_to_agree_twice_as_long(phi: Phi) -> None:
    rng = np.random.default_rng(0)
    watch = RowWatch(phi)
    waits = []
    for _ in range(3):
        for bad, until in ((True, True), (False, False)):
            frames = 0
            while bool(watch.left_out[7]) != until:
                y = rng.normal(0, 0.01, M).astype(np.float32)
                if bad:
                    y[7] = 1.0 + frames
                watch.update(y, np.zeros(M, np.float32))
                frames += 1
        waits.append(frames)
    assert waits[1] > 1.5 * waits[0]
    assert waits[2] > 1.5 * waits[1]


@pytest.mark.parametrize(("change_n", "faulty"), [(0.01, False), (1.0, True)])
def test_a_row_that_the_frame_was_not_made_from_is_judged_by_its_change(
    phi: Phi, change_n: float, faulty: bool
) -> None:
    """Its residual is larger than that of its peers, in all frames alike."""
    rng = np.random.default_rng(0)
    watch = RowWatch(phi)
    unfitted = np.array([7])
    for _ in range(60):
        y = rng.normal(0, 0.01, M).astype(np.float32)
        y[7] = 0.5 + rng.normal(0, change_n)
        watch.update(y, np.zeros(M, np.float32), unfitted)
    assert list(np.flatnonzero(watch.left_out)) == ([7] if faulty else [])


@pytest.mark.parametrize("pair", [(250, 251), (60, 61)])
def test_a_faulty_row_is_found_by_its_innovation_where_the_frame_explains_it(
    phi: Phi, pair: tuple[int, int]
) -> None:
    """A solver that starts anew fits what it reads: residuals are noise, innovations are not."""
    rng = np.random.default_rng(0)
    watch = RowWatch(phi)
    for _ in range(40):
        y = rng.normal(0, 0.01, M).astype(np.float32)
        fitted = y + rng.normal(0, 0.01, M).astype(np.float32)
        y[list(pair)] += (garbage := rng.uniform(-2, 2, 2).astype(np.float32))
        fitted[list(pair)] += garbage
        watch.update(y, fitted)
    assert tuple(np.flatnonzero(watch.left_out)) == pair


@pytest.mark.parametrize(
    ("kind", "watches"), [("sbhe", True), ("full", False), ("subsample", False)]
)
def test_a_row_that_reads_one_taxel_has_no_peers_and_is_not_judged(
    kind: str, watches: bool
) -> None:
    watch = RowWatch(make_phi(kind, 256, 256 if kind == "full" else 85, seed=0))
    assert watch.watches == watches
    y = np.zeros(watch.left_out.size, np.float32)
    for _ in range(30):
        y[1] += 5.0  # of "sbhe", row 0 is the sum of the only block
        watch.update(y + 0.01, np.zeros_like(y))
    assert watch.left_out.any() == watches


def test_of_a_skin_that_does_not_state_its_noise_nothing_is_left_out(phi: Phi) -> None:
    """Exact frames that stand still repeat their measurements, and no measurement is faulty."""
    pressed = np.zeros((60, *SHAPE), np.float32)
    pressed[:, 10:15, 8:20] = 1.0
    desk = Desk(phi, states_noise=False)
    desk.messages(phi.forward(pressed.reshape(-1, N)))
    assert desk.lines == []


@pytest.mark.parametrize("m", [67, 40])
def test_a_row_subset_without_a_row_that_a_bias_shows_in_is_watched_all_the_same(m: int) -> None:
    rng = np.random.default_rng(0)
    subsets = row_subsets(make_phi("sbhe", N, m, seed=0), "rotating")
    without = [phi for phi in subsets if not phi.forward(np.ones(N, np.float32)).any()]
    assert without
    for phi in without:
        watch = RowWatch(phi)
        for _ in range(30):
            y = rng.normal(0, 0.1, phi.m).astype(np.float32)
            y[7] = 9.0
            watch.update(y, np.zeros(phi.m, np.float32))
        assert list(np.flatnonzero(watch.left_out)) == [7]


def test_where_most_rows_disagree_none_is_blamed(phi: Phi) -> None:
    rng = np.random.default_rng(0)
    watch = RowWatch(phi)
    for _ in range(30):
        y = rng.normal(0, 0.01, M).astype(np.float32)
        y[: M // 3] += rng.choice([-1, 1], M // 3)
        watch.update(y, np.zeros(M, np.float32))
    assert watch.swamped
    assert not watch.left_out.any()


def test_faulty_measurements_are_replaced_from_the_last_frame(phi: Phi, truth: Floats) -> None:
    watch = RowWatch(phi)
    watch.left_out[[1, 5]] = True
    y = np.full(M, 9.0, np.float32)
    last = truth[-1].reshape(-1)
    cleaned = watch.cleaned(y, last)
    np.testing.assert_array_equal(cleaned[[1, 5]], phi.forward(last)[[1, 5]])
    np.testing.assert_array_equal(np.delete(cleaned, [1, 5]), 9.0)
    np.testing.assert_array_equal(watch.cleaned(y, None)[[1, 5]], 0)
    np.testing.assert_array_equal(y, 9.0)
