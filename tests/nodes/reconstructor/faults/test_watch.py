"""The watch of a patch: no measurement is replaced, and all ways to it give the same reasons."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pressed import noisy, sliding_disc

from sparseskin import Stream
from sparseskin.messages import Reason
from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.faults.watch import (
    MOST_NAMED,
    FaultWatch,
    Noise,
    listed,
    mixed_taxels,
    solve_watched,
    watch_of,
)
from sparseskin.nodes.reconstructor.solvers.base import make_rotating_solver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.stability import faults
from sparseskin.studies.stability.verdicts import WAYS
from sparseskin.studies.stability.worlds import Times, draw_world

SHAPE = (40, 40)
N = 1600
F_MAX = 2.5
PHI = make_phi("sbhe", N, N // 2, seed=0)
NOISE = NoiseModel()
LEAST_SD = 0.584 * NOISE.sigma_end
DISC = sliding_disc(SHAPE, 60, touch_at=10)
TIMES = Times(touch=4, release=50, end=60, earliest_fault=10, latest_fault=30)


class Watched:
    """A solver under watch, and the lines of its log."""

    def __init__(self, **settings):
        self.lines = []
        self.subsets = row_subsets(PHI, "rotating")
        self.solver = make_rotating_solver(
            "skin", self.subsets, make_basis("haar", *SHAPE)
        )
        self.solver.noise_sd = LEAST_SD
        self.solver.noise_model = NOISE
        noise = Noise(F_MAX, LEAST_SD)
        self.watch = FaultWatch(noise, SHAPE, self.lines.append, **settings)
        self.n_frames = 0

    def next_phi(self):
        """Phi of the next frame, which the solver uses."""
        phi = self.subsets[self.n_frames % len(self.subsets)]
        self.solver.use(phi)
        self.n_frames += 1
        return phi

    def frame(self, readings, spoil=None):
        """Verdict on a frame whose measurements a function may spoil."""
        phi = self.next_phi()
        y = phi.forward(readings.reshape(-1))
        if spoil is not None:
            y = spoil(y)
        return solve_watched(self.solver, self.watch, phi, y)


class Plain:
    """A solver that states nothing but what it has to."""


@pytest.mark.parametrize(
    ("largest", "returned", "reason"),
    [(2.4, 2.4, ""), (2.6, 2.5, ""), (2.75, 2.5, ""), (2.8, 2.8, Reason.RANGE)],
)
def test_forces_beyond_the_range_by_more_than_a_tenth_are_marked(
    largest, returned, reason
):
    watch = FaultWatch(Noise(F_MAX), SHAPE)
    forces = np.zeros(SHAPE, dtype=np.float32)
    forces[3, 4] = largest
    verdict = watch.look(Plain(), PHI, forces)
    assert verdict.forces[3, 4] == np.float32(returned)
    assert verdict.reason == reason


@given(f_max=st.floats(1e-3, 1e3), part=st.floats(0.0, 0.99) | st.floats(1.11, 9.0))
def test_the_range_is_that_of_the_skin(f_max, part):
    forces = np.full(SHAPE, part * f_max, dtype=np.float32)
    verdict = FaultWatch(Noise(f_max), SHAPE).look(Plain(), PHI, forces)
    assert verdict.reason == (Reason.RANGE if part > 1 else "")
    np.testing.assert_array_equal(verdict.forces, forces)


def doubting(doubt):
    """A solver that doubts its measurements, by number."""
    solver = Plain()
    solver.doubt = np.zeros(PHI.m, dtype=np.float32)
    for row, value in doubt.items():
        solver.doubt[row] = value
    return solver


def test_a_measurement_is_doubted_once_the_mean_doubt_is_above_a_half():
    """With a rate of 0.2, 1 - 0.8^4 is the first one above."""
    watch = FaultWatch(Noise(F_MAX), SHAPE)
    forces = np.zeros(SHAPE, dtype=np.float32)
    rows = [watch.look(doubting({5: 1.0}), PHI, forces).rows for _ in range(6)]
    assert rows == [()] * 3 + [(5,)] * 3
    # 1 - 0.8^6 takes two frames to fall below.
    rows = [watch.look(doubting({}), PHI, forces).rows for _ in range(3)]
    assert rows == [(5,), (), ()]


def test_measurements_of_all_row_subsets_are_doubted():
    watch = FaultWatch(Noise(F_MAX), SHAPE)
    forces = np.zeros(SHAPE, dtype=np.float32)
    first, second = row_subsets(PHI, "rotating")[:2]
    for _ in range(4):
        watch.look(doubting({9: 1.0}), first, forces)
        verdict = watch.look(doubting({2: 1.0, 9: 1.0}), second, forces)
    assert verdict.rows == (2, 9)
    for _ in range(4):
        verdict = watch.look(doubting({}), second, forces)
    assert verdict.rows == (9,)


def test_lines_name_the_measurements_that_are_doubted_anew():
    lines = []
    watch = FaultWatch(Noise(F_MAX), SHAPE, lines.append)
    forces = np.zeros(SHAPE, dtype=np.float32)
    for k in range(12):
        watch.look(doubting({5: 1.0} | ({8: 1.0} if k >= 6 else {})), PHI, forces)
    assert [line.rpartition(": ")[2] for line in lines] == ["5", "8"]


@given(n=st.integers(1, 120))
def test_of_lines_of_one_kind_the_first_three_and_each_tenth_hundredth_are_logged(n):
    lines = []
    watch = FaultWatch(Noise(F_MAX, LEAST_SD), SHAPE, lines.append)
    constant = np.zeros(PHI.m, dtype=np.float32)
    for k in range(n):
        watch.glance(PHI, constant)
        watch.glance(PHI, np.random.default_rng(k).normal(size=PHI.m).astype("f4"))
    assert len(lines) == min(n, 3) + (n >= 10) + (n >= 100)


class Sums(Phi):
    """A matrix whose i-th row sums the first `counts[i]` taxels."""

    kind = "sums"

    def __init__(self, counts):
        super().__init__(max(*counts, 16, len(counts)), len(counts), 0)
        self.counts = counts
        self.fingerprint = f"{hash(tuple(counts)):016x}"

    @property
    def lipschitz(self):
        return float(self.n * self.m)

    def _forward(self, x, out):
        out[:] = [x[:count].sum() for count in self.counts]

    def _adjoint(self, y, out):
        out[:] = 0
        for count, value in zip(self.counts, y, strict=True):
            out[:count] += value


@given(counts=st.lists(st.integers(1, 40), min_size=2, max_size=8))
def test_the_taxels_that_a_matrix_mixes_are_the_median_of_those_of_its_rows(counts):
    middle = sorted(counts)[len(counts) // 2]
    assert mixed_taxels(Sums(counts)) == pytest.approx(middle)


@given(count=st.integers(1, 40), m=st.integers(9, 60))
def test_rows_that_sum_as_many_taxels_mix_these(count, m):
    assert mixed_taxels(Sums([count] * m)) == pytest.approx(count)


@pytest.mark.parametrize(("count", "reason"), [(7, ""), (8, Reason.CONSTANT)])
def test_measurements_of_eight_taxels_each_are_watched(count, reason):
    watch = FaultWatch(Noise(F_MAX, LEAST_SD), SHAPE)
    assert watch.glance(Sums([count] * 9), np.zeros(9, dtype=np.float32)) == reason


def spoilt_by(kind, rng):
    """A function that spoils measurements."""

    def spoil(y):
        if kind == "garbage":
            return rng.uniform(-5, 5, y.size).astype(np.float32)
        if kind == "outlier":
            y = y.copy()
            y[rng.integers(y.size)] += 60
            return y
        if kind == "offset":
            return y + np.float32(0.7)
        if kind == "gain":
            return y * np.float32(1.5)
        return y

    return spoil


@settings(max_examples=15)
@given(
    kind=st.sampled_from(["garbage", "outlier", "offset", "gain", "none"]),
    seed=st.integers(0, 99),
)
def test_no_measurement_is_replaced(kind, seed):
    """All that is subtracted is one number."""
    watched = Watched()
    rng = np.random.default_rng(seed)
    spoil = spoilt_by(kind, rng)
    for k, readings in enumerate(noisy(DISC, seed)):
        phi = watched.next_phi()
        y = phi.forward(readings.reshape(-1))
        if k >= 30:
            y = spoil(y)
        believed = watched.watch.receive(watched.solver, phi, y)
        assert believed is not None
        subtracted = y - believed
        np.testing.assert_allclose(subtracted, np.median(subtracted), atol=1e-5)
        watched.watch.look(watched.solver, phi, watched.solver.solve(believed))


@settings(max_examples=12)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(sorted(faults.KINDS)),
    rows=st.sampled_from(["fixed", "rotating"]),
)
def test_all_ways_give_the_same_reasons(seed, kind, rows):
    world = draw_world(seed, True, fault=kind, rows=rows, sides=(12, 16), times=TIMES)
    world = replace(world, noise=world.noise._replace(kind="paper", is_stated=True))
    reasons = {}
    for way, stream in WAYS.items():
        answers = [answer for _, answer in stream(world, "off")]
        reasons[way] = [
            "lost" if answer is None else answer.reason for answer in answers
        ]
    assert reasons["graph"] == reasons["Stream"]
    # Arrays have no sensor, which finds readings that repeat, and states one of these.
    sensed = {Reason.STUCK, Reason.FROZEN, Reason.CLIPPED}
    for of_arrays, of_stream in zip(reasons["arrays"], reasons["Stream"], strict=True):
        assert of_arrays == of_stream or of_stream in sensed


@pytest.mark.parametrize("reason", [Reason.CONSTANT, Reason.FROZEN])
def test_frames_that_hold_nothing_are_the_last_one_and_logged_once(reason):
    watched = Watched()
    frames = noisy(DISC)
    for readings in frames[:40]:
        last = watched.frame(readings)
    assert last.reason == ""

    held = PHI.forward(frames[40].reshape(-1))
    if reason is Reason.CONSTANT:
        held = np.full_like(held, 0.3)
    verdicts = [watched.frame(frames[40], lambda _: held) for _ in range(12)]
    assert [verdict.reason for verdict in verdicts[5:]] == [reason] * 7
    assert last.is_solved
    assert not verdicts[-1].is_solved
    for verdict in verdicts[6:]:
        np.testing.assert_array_equal(verdict.forces, verdicts[5].forces)
    assert watched.lines == [f"{reason.phrase}: not trusted"]

    # The frames after it are right again.
    for readings in frames[41:]:
        verdict = watched.frame(readings)
    error = np.linalg.norm(verdict.forces - DISC[-1]) / np.linalg.norm(DISC[-1])
    assert error < 0.1
    assert verdict.reason == ""


def test_clipped_measurements_are_marked_and_solved():
    watched = Watched()
    frames = noisy(DISC)
    for readings in frames[:30]:
        watched.frame(readings)
    verdict = watched.frame(frames[30], lambda y: np.maximum(y, 0))
    assert verdict.reason == Reason.CLIPPED


def test_an_offset_is_stated_and_logged_until_it_ends():
    watched = Watched()
    for k, readings in enumerate(noisy(DISC)):
        is_spoilt = 30 <= k < 50
        offset = np.float32(0.7) if is_spoilt else np.float32(0)
        watched.frame(readings, lambda y, offset=offset: y + offset)
        text = "offset of all measurements subtracted: 0.7" if is_spoilt else ""
        assert watched.watch.text == text
    began = "all measurements have an offset of 0.7, which is subtracted"
    assert watched.lines == [began, "all measurements have no offset"]


def test_doubted_measurements_are_stated_and_logged_until_they_are_right_again():
    watched = Watched()

    def spoil(y):
        y = y.copy()
        y[[7, 300]] += 40
        return y

    frames = noisy(DISC)
    for k, readings in enumerate(frames[:45]):
        verdict = watched.frame(readings, spoil if k >= 30 else None)
    assert verdict.rows == (7, 300)
    assert watched.watch.text == "measurements doubted: 7, 300"
    assert "measurements doubted, no force explains them: 7, 300" in watched.lines

    for readings in frames[45:]:
        verdict = watched.frame(readings)
    assert verdict.rows == ()
    assert watched.watch.text == ""


def test_a_watch_that_is_reset_has_forgotten_all():
    watched = Watched()
    for readings in noisy(DISC):
        watched.frame(readings, lambda y: y + np.float32(0.7))
    assert watched.watch.text != ""
    watched.watch.reset()
    assert watched.watch.text == ""
    assert not watched.watch.last_forces.any()


def test_where_rows_are_not_watched_no_offset_is_subtracted():
    watched = Watched(watch_rows=False)
    for k, readings in enumerate(noisy(DISC)):
        watched.frame(readings, (lambda y: y + np.float32(0.7)) if k >= 30 else None)
    assert "offset" not in watched.watch.text


def test_single_taxels_may_repeat():
    phi = make_phi("subsample", 256, 85, seed=0)
    watch = FaultWatch(Noise(F_MAX, LEAST_SD), (16, 16))
    zero = np.zeros(85, dtype=np.float32)
    assert [watch.glance(phi, zero) for _ in range(20)] == [""] * 20


@pytest.mark.parametrize(
    ("kind", "is_mixed"), [("sbhe", True), ("gaussian", True), ("full", False)]
)
def test_measurements_mix_taxels_but_for_single_ones(kind, is_mixed):
    phi = make_phi(kind, 256, 256 if kind == "full" else 85, seed=0)
    assert (mixed_taxels(phi) >= 8) == is_mixed


def test_few_names_are_listed_and_more_counted():
    assert listed([3, 5]) == "3, 5"
    assert listed([*range(MOST_NAMED)]) == ", ".join(map(str, range(MOST_NAMED)))
    assert listed([*range(MOST_NAMED + 2)]).startswith("0, 1, ")
    assert listed([*range(MOST_NAMED + 2)]).endswith(f", {MOST_NAMED - 1} and 2 more")


def unclear(reasons):
    """A watch, a solver and forces of a frame of which several reasons hold."""
    watch = FaultWatch(Noise(F_MAX), np.ones(SHAPE, dtype=np.bool_))
    solver = Plain()
    forces = np.zeros(SHAPE, dtype=np.float32)
    if Reason.CLIPPED in reasons:
        watch._received = Reason.CLIPPED
    if Reason.RANGE in reasons:
        forces[3, 4] = 2 * F_MAX
    solver.trusted = Reason.ERROR not in reasons
    return watch, solver, forces


#: What makes another reason meaningless comes before it.
IN_ORDER = [
    Reason.CLIPPED,
    Reason.RANGE,
    Reason.ERROR,
]


@given(reasons=st.sets(st.sampled_from(IN_ORDER)))
def test_of_several_reasons_the_first_is_stated(reasons):
    watch, solver, forces = unclear(reasons)
    verdict = watch.look(solver, PHI, forces)
    assert verdict.reason == next(
        (reason for reason in IN_ORDER if reason in reasons), ""
    )


@pytest.mark.parametrize(
    ("error", "largest", "reason"),
    [
        (0.9 * LEAST_SD, 0.0, Reason.WEAK),
        (0.9 * LEAST_SD, F_MAX, Reason.ERROR),
        (1.1 * LEAST_SD, 0.0, Reason.ERROR),
        (LEAST_SD, 0.0, Reason.WEAK),
        (0.9 * LEAST_SD, 0.011, Reason.WEAK),
        (0.9 * LEAST_SD, 4.9 * LEAST_SD, Reason.WEAK),
        (0.9 * LEAST_SD, 5.1 * LEAST_SD, Reason.ERROR),
        (None, 0.0, Reason.ERROR),
    ],
)
def test_forces_and_error_within_the_stated_noise_are_weak(error, largest, reason):
    watch = FaultWatch(Noise(F_MAX, LEAST_SD), np.ones(SHAPE, dtype=np.bool_))
    solver = Plain()
    solver.trusted = False
    solver.error = error
    forces = np.zeros(SHAPE, dtype=np.float32)
    forces[3, 4] = largest
    assert watch.look(solver, PHI, forces).reason == reason


def test_a_solver_that_states_no_error_is_not_weak():
    solver = Plain()
    solver.trusted = False
    watch = FaultWatch(Noise(F_MAX, LEAST_SD), SHAPE)
    forces = np.zeros(SHAPE, dtype=np.float32)
    assert watch.look(solver, PHI, forces).reason == Reason.ERROR


def alone(**fields):
    """A solver that is used by itself."""
    solver = make_rotating_solver("skin", [PHI], make_basis("haar", *SHAPE))
    for name, value in fields.items():
        setattr(solver, name, value)
    return solver


def test_a_solver_alone_has_one_watch_with_its_noise():
    solver = alone(noise_sd=LEAST_SD)
    watch = watch_of(solver)
    assert watch_of(solver) is watch
    assert watch.last_forces.shape == SHAPE
    assert watch.glance(PHI, np.zeros(PHI.m, dtype=np.float32)) == Reason.CONSTANT
    # Without stated noise, equal measurements may be right.
    silent = watch_of(alone())
    assert silent.glance(PHI, np.zeros(PHI.m, dtype=np.float32)) == ""


@pytest.mark.parametrize(("noise", "reason"), [(None, ""), (NOISE, Reason.RANGE)])
def test_the_range_of_a_solver_alone_is_known_by_its_noise(noise, reason):
    solver = alone(noise_model=noise)
    forces = np.full(SHAPE, 2 * F_MAX, dtype=np.float32)
    assert watch_of(solver).look(Plain(), PHI, forces).reason == reason


def test_measurements_that_the_solver_cannot_use_are_refused_and_not_looked_at():
    watched = Watched()
    phi = watched.next_phi()
    huge = np.full(PHI.m, 10 * watched.solver.y_max, dtype=np.float32)
    for wrong in (huge, np.full(PHI.m - 1, 1, np.float32)):
        with pytest.raises(SolverError):
            watched.watch.receive(watched.solver, phi, wrong)
    assert watched.lines == []


def test_a_stream_that_is_reset_looks_at_frames_anew():
    stream = Stream((16, 16), noise_sd=0.01)
    y = stream.compress(np.ones((16, 16), dtype=np.float32))
    for _ in range(8):
        stream.reconstruct(y)
    assert stream.reason == Reason.FROZEN
    stream.reset()
    stream.reconstruct(y)
    assert stream.reason != Reason.FROZEN
