"""False rows of measurements are found, kept out of the frames and told; rows that work are not."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest
from reconstructor.pressed import noisy, psnr_db, sliding_disc

from sparseskin.messages import Measurements, Message, PhiState, Reconstruction, SkinState
from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.phi import Phi, make_phi
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings
from sparseskin.nodes.reconstructor.row_watch import CONSTANT, HEALED, RowWatch

Floats = npt.NDArray[np.float32]

SHAPE, N, M = (40, 40), 1600, 533
FALSE = (3, 100, 250, 251, 400)
TOUCHED = slice(30, None)


@pytest.fixture(scope="module")
def truth() -> Floats:
    return sliding_disc(SHAPE, 80, touch_at=25)


@pytest.fixture(scope="module")
def phi() -> Phi:
    return make_phi("sbhe", N, M, seed=0)


@pytest.fixture(scope="module")
def y(phi: Phi, truth: Floats) -> Floats:
    return phi.forward(noisy(truth).reshape(-1, N))


def spoilt(y: Floats, fault: str) -> Floats:
    """Measurements with false rows from the first frame on."""
    rng = np.random.default_rng(1)
    wrong = {
        "zero": np.zeros((len(y), len(FALSE))),
        "constant": np.tile(rng.uniform(0.3, 1, len(FALSE)), (len(y), 1)),
        "garbage": rng.uniform(-2, 2, (len(y), len(FALSE))),
    }[fault]
    y = y.copy()
    y[:, FALSE] = wrong
    return y


class Desk:
    """A reconstructor that knows its skin, and what it said."""

    def __init__(self, phi: Phi, *, states_noise: bool = True, **settings: object) -> None:
        self.lines: list[str] = []
        context = Context("reconstructor", ManualClock(0), self.lines.append)
        self.node = Reconstructor(ReconstructorSettings(**settings), context)
        self.phi = phi
        self._stamps = itertools.count(1)
        sigmas = (0.0628, 0.0141) if states_noise else (0.0, 0.0)
        skin = SkinState(
            stamp_ns=0, patch="skin", n_rows=SHAPE[0], n_cols=SHAPE[1], f_max=2.5, unit="N",
            pitch_m=None, mask=None, source="", seed=0, rate_hz=0.0, has_truth=False,
            sigma_mid=sigmas[0], sigma_end=sigmas[1],
        )  # fmt: skip
        told = PhiState(stamp_ns=0, patch="skin", fingerprint=phi.fingerprint, **phi.describe())
        for message in (skin, told):
            list(self.node.step(message))

    def messages(self, y: Floats) -> list[Message]:
        """What is published of the frames of measurements y."""
        found: list[Message] = []
        for one in y:
            measurements = Measurements(
                stamp_ns=next(self._stamps), patch="skin", y=one, phi=self.phi.fingerprint
            )
            found += self.node.step(measurements)
        return found

    def restore(self, y: Floats) -> Floats:
        """Forces of the frames of measurements y."""
        return np.array([m.forces for m in self.messages(y) if isinstance(m, Reconstruction)])


@pytest.mark.parametrize("preset", ["skin", "paper"])
@pytest.mark.parametrize("fault", ["zero", "constant", "garbage"])
def test_false_rows_are_found_and_cost_next_to_nothing_then(
    preset: str, fault: str, phi: Phi, y: Floats, truth: Floats
) -> None:
    sound = psnr_db(Desk(phi, preset=preset).restore(y)[TOUCHED], truth[TOUCHED])
    bad = spoilt(y, fault)
    desk = Desk(phi, preset=preset)
    watched = psnr_db(desk.restore(bad)[TOUCHED], truth[TOUCHED])
    alone = psnr_db(
        Desk(phi, preset=preset, watch_rows=False).restore(bad)[TOUCHED], truth[TOUCHED]
    )
    assert watched > sound - 1.5
    assert alone < sound - 1.5
    assert "false measurements left out: " in desk.node.status()
    left_out = desk.node.state()["left_out"]
    assert set(FALSE) <= set(map(int, left_out.partition("(")[2].rstrip(")").split(", ")))
    told = [line for line in desk.lines if "left out" in line]
    assert sum(line.count(str(row)) for line in told for row in (100, 250, 251, 400)) == 4


@pytest.mark.parametrize("preset", ["skin", "paper"])
@pytest.mark.parametrize("ratio", [3, 8])
def test_rows_that_work_are_never_left_out(preset: str, ratio: int, truth: Floats) -> None:
    phi = make_phi("sbhe", N, N // ratio, seed=0)
    desk = Desk(phi, preset=preset)
    desk.restore(phi.forward(noisy(truth).reshape(-1, N)))
    assert desk.node.state()["left_out"] == ""


@pytest.mark.parametrize("bits", [6, 12, None])
def test_a_skin_without_noise_and_few_bits_have_no_false_rows(
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


def test_a_row_that_works_again_comes_back_and_is_told_so(phi: Phi) -> None:
    y = phi.forward(noisy(np.zeros((CONSTANT + 5, *SHAPE), np.float32)).reshape(-1, N))
    desk = Desk(phi, preset="skin")
    desk.restore(spoilt(y, "zero"))
    assert "5 of 533" in desk.node.status()
    for seed in range(1 + 2 * HEALED // len(y)):
        desk.restore(phi.forward(noisy(np.zeros((len(y), *SHAPE)), seed).reshape(-1, N)))
    assert desk.node.state()["left_out"] == ""
    again = ", ".join(line.partition("again: ")[2] for line in desk.lines if "again" in line)
    assert sorted(map(int, again.split(", "))) == list(FALSE)


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


def test_where_most_rows_disagree_none_is_blamed(phi: Phi) -> None:
    rng = np.random.default_rng(0)
    watch = RowWatch(phi)
    for _ in range(30):
        y = rng.normal(0, 0.01, M).astype(np.float32)
        y[: M // 3] += rng.choice([-1, 1], M // 3)
        watch.update(y, np.zeros(M, np.float32))
    assert watch.swamped
    assert not watch.left_out.any()


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
        y[0] += 5.0
        watch.update(y + 0.01, np.zeros_like(y))
    assert watch.left_out.any() == watches


def test_false_rows_give_way_to_what_the_last_frame_says(phi: Phi, truth: Floats) -> None:
    watch = RowWatch(phi)
    watch.left_out[[1, 5]] = True
    y = np.full(M, 9.0, np.float32)
    last = truth[-1].reshape(-1)
    cleaned = watch.cleaned(y, last)
    np.testing.assert_array_equal(cleaned[[1, 5]], phi.forward(last)[[1, 5]])
    np.testing.assert_array_equal(np.delete(cleaned, [1, 5]), 9.0)
    np.testing.assert_array_equal(watch.cleaned(y, None)[[1, 5]], 0)
    np.testing.assert_array_equal(y, 9.0)


def test_of_a_skin_that_does_not_state_its_noise_nothing_is_left_out(phi: Phi) -> None:
    """Exact frames that stand still repeat their measurements, and no row is false."""
    pressed = np.zeros((60, *SHAPE), np.float32)
    pressed[:, 10:15, 8:20] = 1.0
    desk = Desk(phi, states_noise=False)
    desk.messages(phi.forward(pressed.reshape(-1, N)))
    assert desk.lines == []
