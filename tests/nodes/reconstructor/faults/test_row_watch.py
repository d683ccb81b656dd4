"""Faulty measurements are found, excluded and logged; working ones are not."""

import numpy as np
import pytest
from pressed import noisy, psnr_db, sliding_disc
from watched import DESK_SHAPE as SHAPE
from watched import Desk, N

from sparseskin.nodes.compressor.phi.base import RANDOM, make_phi
from sparseskin.nodes.compressor.phi.rotation import PAPER_BLOCK, row_subsets
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.reconstructor.faults.rows import CONSTANT, HEALED, RowWatch

M = 533
FAULTY = (3, 100, 250, 251, 400)
TOUCHED = slice(30, None)


@pytest.fixture(scope="module")
def truth():
    return sliding_disc(SHAPE, 80, touch_at=25)


@pytest.fixture(scope="module")
def phi():
    return make_phi("sbhe", N, M, seed=0)


def spoilt(y, fault):
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


@pytest.mark.parametrize(
    ("preset", "fault"), [("skin", "zero"), ("paper", "constant"), ("skin", "garbage")]
)
def test_faulty_measurements_are_found_and_cost_next_to_nothing_then(preset, fault, phi, truth):
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


@pytest.mark.parametrize(("preset", "everywhere"), [("skin", True), ("paper", False)])
def test_of_rotating_rows_a_faulty_one_is_found_once_its_subset_was_read_as_often(
    preset, everywhere, truth
):
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


@pytest.mark.parametrize(
    ("preset", "ratio", "bits", "states_noise"),
    [("skin", 3, 6, True), ("skin", 8, None, True), ("paper", 3, None, True), ("skin", 3, None, 0)],
)
def test_working_rows_are_never_left_out(preset, ratio, bits, states_noise, truth):
    """Nor on a skin that does not state its noise, whose exact frames may stand still."""
    phi = make_phi("sbhe", N, N // ratio, seed=0)
    desk = Desk(phi, preset=preset, states_noise=states_noise)
    for frames in (truth, noisy(truth)) if states_noise else (truth[[-1] * 60],):
        y = phi.forward(frames.reshape(-1, N))
        desk.messages(y if bits is None else [quantised(one, bits) for one in y])
        assert desk.node.state()["left_out"] == ""
    assert states_noise or desk.lines == []


def test_a_row_that_works_again_is_used_again_and_logged(phi):
    y = phi.forward(noisy(np.zeros((CONSTANT + 5, *SHAPE), np.float32)).reshape(-1, N))
    desk = Desk(phi, preset="skin")
    desk.restore(spoilt(y, "zero"))
    assert "5 of 533" in desk.node.status()
    for seed in range(1 + 2 * HEALED // len(y)):
        desk.restore(phi.forward(noisy(np.zeros((len(y), *SHAPE)), seed).reshape(-1, N)))
    assert desk.node.state()["left_out"] == ""
    again = ", ".join(line.partition("again: ")[2] for line in desk.lines if "again" in line)
    assert sorted(map(int, again.split(", "))) == list(FAULTY)


def noise(m=M, seed=0, n_frames=30):
    return np.random.default_rng(seed).normal(0, 0.01, (n_frames, m)).astype(np.float32)


def left_out_of(phi, y):
    """Rows left out of frames of measurements, which are reconstructed as 0."""
    watch = RowWatch(phi)
    for one in y:
        watch.update(one, np.zeros_like(one))
    return list(np.flatnonzero(watch.left_out))


@pytest.mark.parametrize("kind", ["sbhe", "full", "subsample"])
def test_a_row_that_reads_one_taxel_has_no_peers_and_is_not_judged(kind):
    phi = make_phi(kind, 256, 256 if kind == "full" else 85, seed=0)
    y = np.full((30, phi.m), 0.01, np.float32)
    y[:, 1] += 5 * np.arange(1, 31)  # of "sbhe", row 0 is the sum of the only block
    assert left_out_of(phi, y) == ([1] if kind == "sbhe" else [])


def test_where_most_rows_disagree_none_is_blamed(phi):
    y = noise()
    y[:, : M // 3] += np.random.default_rng(1).choice([-1, 1], (30, M // 3))
    watch = RowWatch(phi)
    for one in y:
        watch.update(one, np.zeros(M, np.float32))
    assert watch.swamped
    assert not watch.left_out.any()
