"""Faulty measurements and taxels are found, excluded and logged; working ones are not."""

import numpy as np
import pytest
from pressed import noisy, psnr_db, sliding_disc
from watched import DESK_SHAPE as SHAPE
from watched import NOISE, Desk, N, Skin, pad
from watched import SKIN_SHAPE as SKIN_SHAPE

from sparseskin.nodes.compressor.phi.base import RANDOM, make_phi
from sparseskin.nodes.compressor.phi.rotation import PAPER_BLOCK, row_subsets
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.reconstructor.faults.rows import CONSTANT, HEALED, RowWatch
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
def test_of_rotating_rows_a_faulty_one_is_found_in_its_subset(preset, everywhere, truth):
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
    listed = "5 of 534 of row subset {} (3, 100, 250, 251, 400)"
    desk.restore(y[: 3 * (CONSTANT - 1)])  # found by their errors, at most some of them
    assert listed.format(1) not in desk.node.state()["left_out"]
    desk.restore(y[3 * (CONSTANT - 1) :])
    left_out = desk.node.state()["left_out"]
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
        watch.update(one, one)
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
        watch.update(one, one)
    assert watch.swamped
    assert not watch.left_out.any()


N_TAXELS = 784
FRAMES = MEASURED + 60


@pytest.fixture(scope="module")
def skin_phi():
    return make_phi("sbhe", N_TAXELS, N_TAXELS // 3, seed=0)


def test_a_stuck_taxel_is_found_left_out_and_used_when_it_works_again(skin_phi):
    skin, nothing = Skin(skin_phi), pad()
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
def test_what_rests_for_long_or_is_quieter_than_stated_is_a_contact(skin_phi, truth, noise):
    skin = Skin(skin_phi, noise)
    for _ in range(2 * FRAMES):
        skin.read(truth)
    assert skin.lines == []


def test_what_is_left_out_is_the_mean_of_the_neighbours_that_work(skin_phi):
    watch = TaxelWatch(np.ones(SKIN_SHAPE, np.bool_), NOISE, print)
    watch.stuck = {0: 1.0, 29: 1.0, 30: 1.5}
    forces = np.arange(N_TAXELS, dtype=np.float32).reshape(SKIN_SHAPE)
    filled = watch.filled(forces)
    assert filled[0, 0] == np.mean([1, 28])
    assert filled[1, 2] == pytest.approx(np.mean([1, 2, 3, 31, 57, 58, 59]))
    y = skin_phi.forward(forces.reshape(-1))
    without = forces.copy()
    without.reshape(-1)[[0, 29, 30]] -= [1.0, 1.0, 1.5]
    expected = skin_phi.forward(without.reshape(-1))
    np.testing.assert_allclose(watch.cleaned(skin_phi, y), expected, atol=1e-3)


@pytest.mark.parametrize("works", [True, False])
def test_a_column_that_stands_alone_is_suspected_at_once_until_its_noise_is_known(skin_phi, works):
    skin, column = Skin(skin_phi), pad((slice(None), slice(9, 10)), force=2.0)
    readings = {} if works else {(row, 9): 2.0 for row in range(SKIN_SHAPE[0])}
    suspected = []
    for _ in range(80):
        skin.read(column if works else pad(), readings)
        suspected.append(skin.watch.doubts)
    assert all(suspected[10:40])
    assert not suspected[-1]
    assert bool(skin.watch.stuck) != works


def watch():
    return EndWatch(np.ones(SKIN_SHAPE, np.bool_), 2.5)


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


def test_a_dead_taxel_is_logged_filled_in_and_used_again(skin_phi):
    skin = Skin(skin_phi)
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


def test_a_saturated_taxel_is_found_on_an_untouched_skin(skin_phi):
    skin = Skin(skin_phi)
    for _ in range((FULL_LOOKS + 10) * EVERY):
        forces = skin.read(pad(), {(10, 14): 2.5})
    assert skin.lines == ["taxel (10, 14) is stuck at 2.5: left out"]
    assert forces[10, 14] < 0.05
