"""What the default solver believes: its errors, the noise level, the motion between two frames."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.skin.frame_vectors import noise_squares
from sparseskin.nodes.reconstructor.skin.noise_level import NoiseLevel
from sparseskin.nodes.reconstructor.skin.prediction import (
    MotionSums,
    PredictionError,
    motion_of,
)
from sparseskin.nodes.reconstructor.skin.row_subset import FrameNumbers
from sparseskin.nodes.reconstructor.skin.trust import (
    CommonError,
    Confirmation,
    Fit,
    StatedError,
    TaxelNoise,
    Trust,
    estimate_error2,
)
from sparseskin.nodes.reconstructor.skin.tuning import SkinTuning
from sparseskin.nodes.reconstructor.skin.vectors import (
    CONVERGED,
    Innovation,
    Settled,
    StepPlan,
    Steps,
    steps_for,
)
from sparseskin.nodes.reconstructor.solvers.base import make_solver

TUNING = SkinTuning()
M = 200
NONE = np.zeros(4, dtype=np.float32)
POSITIVE = st.floats(1e-6, 1e3)


def frame(silent=0.0, repeated=0.0, n_read=M):
    values = dict.fromkeys(FrameNumbers._fields, 0.0)
    return FrameNumbers(
        **values | {"silent": silent, "repeated": repeated, "n_read": n_read}
    )


def settled(**numbers):
    values = dict.fromkeys(Settled._fields, 0.0) | {"forces": NONE}
    return Settled(**values | numbers)


def innovation(square, repeating):
    values = dict.fromkeys(Innovation._fields, 0.0)
    sums = {
        "squares": square * M,
        "noise_squares": repeating * M,
        "n_read": M,
        "n_known": M,
    }
    return Innovation(**values | sums)


def test_a_solver_that_has_seen_no_frame_has_made_no_error():
    phi = make_phi("sbhe", 256, 128, seed=0)
    solver = make_solver("skin", phi, make_basis("haar", 16, 16), fast="off")
    assert solver.trusted is True


# Trust.


@given(noise=POSITIVE, power=POSITIVE, part=st.floats(0.0, 1.0))
def test_an_error_of_a_quarter_of_the_forces_is_the_largest_that_is_trusted(
    noise, power, part
):
    trust = Trust(TUNING)
    # Neither weak nor explained by noise.
    strong = settled(power=power + noise, residual2=1e9)
    trust.judge(
        strong, (part * 0.249) ** 2 * strong.power, noise, 1.0, bias_is_known=True
    )
    assert trust.holds
    trust.judge(
        strong, (0.251 + part) ** 2 * strong.power, noise, 1.0, bias_is_known=True
    )
    assert not trust.holds


@pytest.mark.parametrize(
    ("power", "residual2", "bias_is_known", "holds"),
    [
        (0.049, 1.9, True, True),
        (0.051, 1.9, True, False),
        (0.049, 2.1, True, False),
        (0.56, 1.9, False, True),
        (0.57, 1.9, False, False),
    ],
)
def test_an_untouched_skin_is_trusted_if_noise_explains_its_residual(
    power, residual2, bias_is_known, holds
):
    trust = Trust(TUNING)
    trust.judge(
        settled(power=power, residual2=residual2), 100.0, 1.0, 1.0, bias_is_known
    )
    assert trust.holds == holds
    trust.forget()
    assert trust.holds


def test_noise_that_is_stated_bounds_the_residual_once_the_bias_is_known():
    trust = Trust(TUNING)
    stated = TaxelNoise(1.0, 0.0, is_stated=True)
    unknown = TaxelNoise(1.0, 0.0, is_stated=False)
    n = 800
    assert trust.excess(stated, n, bias_is_known=True) == pytest.approx(
        6 * math.sqrt(2 / n)
    )
    assert trust.excess(stated, 2, bias_is_known=True) == 1.0
    assert trust.excess(stated, n, bias_is_known=False) == 1.0
    assert trust.excess(unknown, n, bias_is_known=True) == 1.0
    assert trust.excess(unknown, n, bias_is_known=False) == 1.0


def test_the_noise_after_a_silence_is_no_noise_unless_it_is_stated():
    trust = Trust(TUNING)
    level = NoiseLevel(TUNING)
    assert trust.noise_of_skin(4.0, level, frame(), 0.0) == 4.0
    for _ in range(60):
        trust.follow_silence(1.0)
    assert trust.noise_of_skin(4.0, level, frame(), 0.0) == pytest.approx(0.0, abs=1e-4)
    assert trust.noise_of_skin(4.0, level, frame(), 1.0) == pytest.approx(1.0, abs=1e-4)
    assert trust.noise_of_skin(4.0, level, frame(silent=1.0), 0.0) == 4.0
    for _ in range(1000):
        trust.follow_silence(0.0)
    assert trust.noise_of_skin(4.0, level, frame(), 0.0) == pytest.approx(4.0)


# Errors.


@given(noise=POSITIVE, expected2=POSITIVE)
def test_residuals_of_noise_alone_show_no_error_and_the_expected_one_counts(
    noise, expected2
):
    error2 = estimate_error2(Steps(expected2, noise), noise, M, 1.5, 2.0)
    assert error2 == pytest.approx(2 * expected2)


@given(error2=st.floats(1.0, 1e3))
def test_of_clear_residuals_the_error_is_what_exceeds_the_noise(error2):
    steps = Steps(0.0, error2 + 1e-3)
    assert estimate_error2(steps, 1e-3, 10**6, 1.5) == pytest.approx(error2, rel=0.01)


@given(share=st.floats(-0.9, 0.9), force2=st.floats(0.1, 1e3))
def test_a_part_that_all_forces_lack_is_the_common_error(share, force2):
    common = CommonError(TUNING)
    for _ in range(5):
        common.follow(settled(along_x=share * force2, read2=force2))
    assert common.value == pytest.approx(abs(share), rel=1e-3, abs=1e-6)
    common.forget()
    assert common.value == 0.0


def fit(steps, known=1.0, read=1.0, part=0.0, inherited2=0.0, **numbers):
    return Fit(steps, settled(**numbers), part, inherited2, known, read)


def test_the_error_is_that_part_of_the_distance_from_the_readings_which_is_no_noise():
    stated = StatedError(TUNING)
    noise = TaxelNoise(0.75, 0.0, is_stated=True)
    of_frame = fit(Steps(0.25 / TUNING.optimism, 0.75), residual2=1.0)
    for _ in range(60):
        error2 = stated.follow(of_frame, noise, frame())
    assert error2 == pytest.approx(0.25 * (1 + 2 / M))
    assert stated.value == pytest.approx(math.sqrt(error2))


def test_rows_that_were_not_read_are_as_far_away_as_those_that_are_left_out():
    distance2 = fit(
        Steps(0.0, 0.0), read=0.25, part=0.5, residual2=1.0, left_out2=2.0
    ).distance2
    assert distance2 == pytest.approx(0.25 * 1.0 + 0.75 * 2.0 / 0.25)


@pytest.mark.parametrize("floor", ["inherited", "missing"])
def test_no_error_is_smaller_than_what_no_measurement_can_lower(floor):
    stated = StatedError(TUNING)
    noise = TaxelNoise(1e-9, 0.3 if floor == "missing" else 0.0, is_stated=True)
    of_frame = fit(Steps(0.0, 0.0), inherited2=0.3 if floor == "inherited" else 0.0)
    assert stated.follow(of_frame, noise, frame()) == 0.3


@pytest.mark.parametrize(("known", "is_kept"), [(1.0, False), (0.5, True)])
def test_measurements_that_repeat_lower_an_error_of_rows_that_are_never_read_slowly(
    known, is_kept
):
    stated = StatedError(TUNING)
    noise = TaxelNoise(0.0, 0.0, is_stated=True)
    before2 = stated.follow(
        fit(Steps(0.5, 0.0), known=known, residual2=1.0), noise, frame()
    )
    after2 = stated.follow(
        fit(Steps(0.0, 0.0), known=known), noise, frame(repeated=1.0)
    )
    expected2 = before2 / 2 if is_kept else 0.0
    assert after2 == pytest.approx(expected2, abs=1e-12)


# What new rows confirm.


def confirmed(stated2, shown2, noise, n_frames, n_read=M):
    confirmation = Confirmation(TUNING)
    for _ in range(n_frames):
        confirmation.follow(stated2, shown2 + noise, noise, n_read)
    return confirmation.part


@given(
    part=st.floats(0.0, 1.0),
    noise=st.floats(0.0, 10.0),
    n_frames=st.integers(1, 60),
    n_read=st.integers(8, 2000),
)
def test_the_part_of_an_error_that_new_rows_confirm_is_that_of_a_ridge_regression(
    part, noise, n_frames, n_read
):
    stated2 = 2.0
    kept = 1 - TUNING.share_rate
    n_effective = (1 - kept**n_frames) / (1 - kept)
    information = n_effective * n_read / 2 * (stated2 / (stated2 + noise)) ** 2
    expected = (part * information + TUNING.belief) / (information + TUNING.belief)
    shown = confirmed(stated2, part * stated2, noise, n_frames, n_read)
    assert shown == pytest.approx(expected, rel=1e-6)


@given(factor=st.floats(0.01, 1.0))
def test_of_many_rows_whose_residuals_are_a_part_of_those_stated_that_part_is_found(
    factor,
):
    part = confirmed(1.0, factor**2, 0.0, 30, n_read=10**7)
    assert math.sqrt(part) == pytest.approx(factor, rel=1e-2)


@given(motion=POSITIVE)
def test_a_motion_never_makes_an_error_larger(motion):
    assert confirmed(1.0, 1.0 + motion, 0.1, 5) == 1.0


def test_errors_far_below_the_noise_stay_as_they_are_stated():
    assert confirmed(1e-6, 0.0, 1.0, 60) == pytest.approx(1.0, abs=1e-3)


@given(seed=st.integers(0, 99))
def test_what_is_confirmed_follows_from_the_frames_alone(seed):
    rng = np.random.default_rng(seed)
    numbers = rng.exponential(1.0, (20, 3)).tolist()
    parts = []
    for _ in range(2):
        confirmation = Confirmation(TUNING)
        for stated2, innovation2, noise in numbers:
            confirmation.follow(stated2, innovation2, noise, M)
        parts.append(confirmation.part)
    assert parts[0] == parts[1]
    assert 0 < parts[0] <= 1


def test_rows_of_the_last_frame_confirm_nothing_and_new_ones_lower_the_error():
    noise = TaxelNoise(1e-9, 0.0, is_stated=True)
    steps = Steps(0.25, 0.0)
    values = []
    for is_new in (False, True):
        stated = StatedError(TUNING)
        for _ in range(20):
            of_frame = fit(steps, read=0.25, residual2=1.0, left_out2=1.0)
            of_frame = of_frame._replace(is_new=is_new, innovation2=1e-3)
            error2 = stated.follow(of_frame, noise, frame())
        values.append(stated.value**2 / error2)
    assert values[0] == pytest.approx(1.0)
    assert values[1] < 0.5


def test_noise_that_is_not_stated_may_be_motion_so_far_as_it_is_not_trusted():
    assert TaxelNoise(4.0, 0.0, is_stated=True, trust=0.25).at_least == 4.0
    assert TaxelNoise(4.0, 0.0, is_stated=False, trust=0.25).at_least == 1.0


# Noise level.


def followed(n_frames, variance, level=None, **of_frame):
    level = level or NoiseLevel(TUNING)
    for _ in range(n_frames):
        level.learn(settled(residual2=variance), 0.0)
        level.follow(innovation(2 * variance, variance), frame(**of_frame))
    return level


@given(variance=st.floats(1e-6, 1e3))
def test_the_level_is_what_does_not_repeat_of_the_innovations(variance):
    level = followed(10, variance)
    assert level.variance == pytest.approx(variance)
    assert level.least == pytest.approx(variance)


@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.floats(1e-3, 1e3),
    part=st.floats(0.0, 1.0),
)
def test_what_a_prediction_comes_nearer_by_is_no_noise(seed, scale, part):
    rng = np.random.default_rng(seed)
    n = 4000
    error = rng.normal(0, 1, n)
    last_noise, noise = rng.normal(0, scale, (2, n))
    change = part * error
    last = (error + last_noise).astype(np.float32)
    new = (error - change + noise).astype(np.float32)
    squares = float(new @ new)
    shown = noise_squares(new, last, change.astype(np.float32), squares) / n
    # Products of the innovation that counts more, and of the noise of both frames.
    square = min(np.mean(np.square(last)), np.mean(np.square(new)))
    deviation = scale * np.sqrt(2 * square / n) + 1e-6 * square
    assert abs(shown - scale**2) < 6 * deviation


@pytest.mark.parametrize(("n_frames", "is_known"), [(5, False), (6, True)])
def test_the_level_is_known_after_six_frames(n_frames, is_known):
    assert followed(n_frames, 1.0).is_known == is_known


def test_frames_that_repeat_exactly_show_no_noise():
    level = followed(10, 1.0)
    followed(50, 0.0, level, repeated=1.0)
    assert level.variance == pytest.approx(1.0)
    assert not followed(50, 1.0, repeated=1.0).is_known


def test_the_level_is_at_least_the_resolution_and_the_stated_noise():
    level = followed(10, 1.0)
    level.keep_above(2.0, 0.5)
    assert level.variance == 2.0
    level.keep_above(0.0, 3.0)
    assert level.variance == 9.0


def test_noise_beyond_four_times_the_least_is_no_noise_of_a_measurement():
    level = followed(10, 1.0)
    assert level.bounded(3.9) == 3.9
    assert level.bounded(7.0) == pytest.approx(4.0)
    assert followed(2, 1.0).bounded(7.0) == pytest.approx(1.0)


def test_the_trust_falls_where_innovations_follow_corrections_and_comes_back():
    level = NoiseLevel(TUNING)
    assert level.trust == 1.0
    level.follow_trust(0.0, 100)
    assert level.trust == 1.0
    level.follow_trust(0.5, 100)
    assert level.trust == pytest.approx(math.exp(2 / 10 - 0.5))
    before = level.trust
    level.follow_trust(0.0, 100)
    assert level.trust == pytest.approx(before * math.exp(0.05))
    for _ in range(100):
        level.follow_trust(1.0, 100)
    assert level.trust == 0.05


def test_a_level_that_is_forgotten_is_that_of_a_new_one():
    level = followed(10, 1.0)
    level.follow_trust(1.0, 100)
    level.forget()
    assert level.variance == 0.0
    assert level.least == 0.0
    assert level.trust == 1.0
    assert not level.is_known


def test_a_jump_of_the_noise_is_followed_by_steps_of_four_tenths():
    level = followed(10, 1.0)
    level.follow(innovation(1e6, 1e6), frame(n_read=8))
    assert level.variance == pytest.approx(1.4)


# Motion.


def moved(rng, n, growth=0.0, down=0.0, across=0.0):
    """Sums of frames of random terms, of a motion that is known."""
    a, b, c = rng.normal(0, 1, (3, n))
    change = growth * a + down * b + across * c
    return MotionSums(
        *(a @ a, a @ b, a @ c, b @ b, b @ c, c @ c),
        *(a @ change, b @ change, c @ change),
        energy=a @ a,
        largest=2.0,
        n_read=n,
        n=n,
    )


@given(
    growth=st.floats(-0.5, 0.5),
    down=st.floats(-0.5, 0.5),
    across=st.floats(-0.5, 0.5),
    seed=st.integers(0, 99),
)
def test_a_clear_motion_is_found(growth, down, across, seed):
    sums = moved(np.random.default_rng(seed), 100, growth, down, across)
    motion = motion_of(sums, 1e-9, 0.0, TUNING)
    assert motion.growth == pytest.approx(growth, abs=0.01)
    assert motion.down == pytest.approx(down, abs=0.01)
    assert motion.across == pytest.approx(across, abs=0.01)
    assert motion.bound == pytest.approx(2 * max(1 + motion.growth, 1))


@pytest.mark.parametrize(("n_read", "is_found"), [(15, False), (16, True)])
def test_a_few_measurements_show_no_motion(n_read, is_found):
    motion = motion_of(
        moved(np.random.default_rng(0), n_read, growth=0.5), 1e-9, 0.0, TUNING
    )
    assert (motion.growth > 0.4) == is_found


def test_of_a_change_as_large_as_its_noise_half_is_motion():
    sums = moved(np.random.default_rng(0), 100, growth=0.1)
    noise = 0.1 * sums.a_change / TUNING.motion
    clear = motion_of(sums, 1e-9, 0.0, TUNING).growth
    assert motion_of(sums, noise, 0.0, TUNING).growth == pytest.approx(
        clear / 2, rel=0.01
    )


def test_forces_at_most_double_from_frame_to_frame():
    motion = motion_of(
        moved(np.random.default_rng(0), 100, growth=3.0), 1e-9, 0.0, TUNING
    )
    assert motion.growth == 1.0
    assert motion.bound == 4.0


@given(noise=POSITIVE)
def test_innovations_of_noise_alone_leave_no_error_of_the_prediction(noise):
    prediction = PredictionError(TUNING)
    for _ in range(20):
        assert prediction.follow(noise, noise, M) == 0.0
    assert prediction.significant == 0.0


def test_a_clear_excess_of_the_innovation_is_the_error_of_the_prediction():
    prediction = PredictionError(TUNING)
    assert prediction.follow(101.0, 1.0, 10**4) == pytest.approx(100.0, rel=1e-3)
    assert prediction.significant == pytest.approx(100.0, rel=1e-3)
    after = prediction.follow(1.0, 1.0, 10**4)
    assert 0 < after < 1


def test_innovations_that_point_along_corrections_are_of_correlation_one():
    values = dict.fromkeys(Innovation._fields, 0.0) | {"n_read": M}
    along = Innovation(
        **values | {"squares": 4.0, "correction_squares": 9.0, "products": 6.0}
    )
    assert along.correlation == pytest.approx(1.0, rel=1e-5)
    assert along.mean_square == 4.0 / M
    without = Innovation(**values | {"squares": 4.0})
    assert without.correlation == 0.0


# Steps.


@given(
    n_busy=st.integers(0, 5000),
    frame_tiles=st.integers(1, 40_000),
    step=st.integers(1, 50),
)
def test_chosen_steps_fit_into_the_time_of_a_frame(n_busy, frame_tiles, step):
    plan = StepPlan(0, 2, 0, frame_tiles, step, 30, 0.0, 0.0)
    chosen = steps_for(plan, n_busy)
    if chosen == plan:
        return
    time = chosen.n_formula * (step + n_busy // 4) + chosen.n * (step + n_busy)
    assert time <= frame_tiles
    assert plan.n <= chosen.n <= plan.most
    assert chosen.n_formula == (3 if chosen.n < CONVERGED else 0)


def test_a_plan_without_a_time_stays_as_it_is():
    plan = StepPlan(0, 9, 0, 0, 0, 30, 0.0, 0.0)
    assert steps_for(plan, 100) == plan
