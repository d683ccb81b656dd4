"""An offset of all measurements is found and subtracted; forces are no offset."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pressed import noisy, sliding_disc

from sparseskin import Stream
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import ROTATING, row_subsets
from sparseskin.nodes.reconstructor.faults.offset import OffsetWatch
from sparseskin.nodes.sensor.noise import NoiseModel

SIDE = 40
N = 1600
PHI = make_phi("sbhe", N, N // 3, seed=0)
NOISE = NoiseModel()
LEAST_SD = 0.584 * NOISE.sigma_end
SIGMAS = (NOISE.sigma_mid, NOISE.sigma_end)
DISC = sliding_disc((SIDE, SIDE), 60, touch_at=10)


def innovation(seed):
    """Innovation of an untouched skin."""
    rng = np.random.default_rng(seed)
    return rng.normal(0, LEAST_SD, PHI.m).astype(np.float32)


@given(offset=st.floats(0.05, 30.0), sign=st.sampled_from([-1, 1]))
def test_an_offset_is_known_while_it_lasts(offset, sign):
    watch = OffsetWatch(LEAST_SD)
    for seed in range(20):
        value = watch.look(PHI, innovation(seed) + np.float32(sign * offset))
        assert value == pytest.approx(sign * offset, abs=0.01)
    assert watch.look(PHI, innovation(20)) == 0.0


@given(
    before=st.floats(0.05, 30.0),
    after=st.floats(0.05, 30.0),
    signs=st.tuples(st.sampled_from([-1, 1]), st.sampled_from([-1, 1])),
)
def test_an_offset_that_changes_is_followed_at_once(before, after, signs):
    watch = OffsetWatch(LEAST_SD)
    watch.look(PHI, innovation(0) + np.float32(signs[0] * before))
    value = watch.look(PHI, innovation(1) + np.float32(signs[1] * after))
    assert value == pytest.approx(signs[1] * after, abs=0.01)


ROWS = OffsetWatch(LEAST_SD).rows_of(PHI)
#: An innovation of this size in all rows is one standard deviation of its mean.
DEVIATION = LEAST_SD / np.sqrt(PHI.m)


def same_in_all_rows(n_deviations):
    return np.full(PHI.m, n_deviations * DEVIATION, dtype=np.float32)


@given(
    n_deviations=st.floats(1.0, 5.9) | st.floats(6.1, 100.0),
    sign=st.sampled_from([-1, 1]),
)
def test_a_change_of_six_deviations_is_the_least_that_is_an_offset(n_deviations, sign):
    watch = OffsetWatch(LEAST_SD)
    value = watch.look(PHI, same_in_all_rows(sign * n_deviations))
    expected = sign * n_deviations * DEVIATION if n_deviations > 6 else 0.0
    assert value == pytest.approx(expected, rel=1e-4)
    assert watch.value == value


@given(scale=st.sampled_from([1e-3, 1.0, 1e3, 1e5]), offset=st.floats(0.05, 2.0))
def test_the_unit_of_the_readings_does_not_matter(scale, offset):
    """As of counts of a converter, which are thousands."""
    watch = OffsetWatch(scale * LEAST_SD)
    for seed in range(3):
        changed = scale * (innovation(seed) + np.float32(offset))
        value = watch.look(PHI, changed.astype(np.float32))
        assert value == pytest.approx(scale * offset, rel=0.2)
    assert watch.look(PHI, (scale * innovation(3)).astype(np.float32)) == 0.0


@given(
    before=st.floats(20.0, 50.0),
    after=st.floats(1.0, 5.9) | st.floats(6.1, 13.0),
    signs=st.tuples(st.sampled_from([-1, 1]), st.sampled_from([-1, 1])),
)
def test_an_offset_that_falls_below_six_deviations_has_ended(before, after, signs):
    watch = OffsetWatch(LEAST_SD)
    watch.look(PHI, same_in_all_rows(signs[0] * before))
    value = watch.look(PHI, same_in_all_rows(signs[1] * after))
    expected = signs[1] * after * DEVIATION if after > 6 else 0.0
    assert value == pytest.approx(expected, rel=1e-4)


@given(
    block=st.integers(0, len(ROWS.starts) - 1),
    z=st.floats(0.0, 3.9) | st.floats(4.1, 8.0),
    sign=st.sampled_from([-1, 1]),
)
def test_a_block_may_differ_by_four_deviations_of_its_mean(block, z, sign):
    n_light = ROWS.n_light[block]
    n_all = ROWS.n_light.sum()
    # By so much the mean of the block exceeds that of all.
    excess = z * LEAST_SD / np.sqrt(n_light)
    added = sign * excess / (1 - n_light / n_all)
    change = same_in_all_rows(50) + np.where(ROWS.block == block, added, 0)
    value = OffsetWatch(LEAST_SD).look(PHI, change.astype(np.float32))
    expected = 50 * DEVIATION + added * n_light / n_all if z < 4 else 0.0
    assert value == pytest.approx(expected, rel=1e-3)


@given(press=st.floats(-30.0, 30.0), n_deviations=st.floats(30.0, 100.0))
def test_rows_that_sum_a_whole_block_show_no_offset(press, n_deviations):
    change = same_in_all_rows(n_deviations)
    change[~ROWS.light] += np.float32(press)
    # Unless their mean hides it.
    if abs(change.mean()) < 30 * DEVIATION:
        return
    value = OffsetWatch(LEAST_SD).look(PHI, change)
    assert value == pytest.approx(n_deviations * DEVIATION, rel=1e-3)


def test_each_row_belongs_to_the_block_whose_first_row_comes_before_it():
    expected = np.searchsorted(ROWS.starts, np.arange(PHI.m), side="right") - 1
    np.testing.assert_array_equal(ROWS.block, expected)
    assert ROWS.starts[0] == 0
    np.testing.assert_array_equal(ROWS.n_light, np.bincount(ROWS.block, ROWS.light))


@given(spread=st.floats(0.0, 3.0), n_deviations=st.floats(30.0, 60.0))
def test_innovations_that_scatter_more_than_the_noise_need_a_larger_change(
    spread, n_deviations
):
    """Rows of a block that differ by turns, so that their mean stays: their spread counts."""
    turns = np.where(np.arange(PHI.m) % 2, 1.0, -1.0)
    pairs = ROWS.light[:-1] & ROWS.light[1:] & (ROWS.block[:-1] == ROWS.block[1:])
    scatter = np.zeros(PHI.m)
    for row in np.flatnonzero(pairs)[::2]:
        if not scatter[row] and not scatter[row + 1]:
            scatter[row : row + 2] = turns[row : row + 2]
    change = same_in_all_rows(n_deviations) + 20 * spread * LEAST_SD * scatter
    variance = max((20 * spread) ** 2 * np.mean(scatter**2), 1.0)
    z = n_deviations / np.sqrt(variance)
    if abs(z - 6) < 0.2:
        return
    value = OffsetWatch(LEAST_SD).look(PHI, change.astype(np.float32))
    expected = n_deviations * DEVIATION if z > 6 else 0.0
    assert value == pytest.approx(expected, rel=1e-3)


def test_noise_is_no_offset():
    watch = OffsetWatch(LEAST_SD)
    values = [watch.look(PHI, innovation(seed)) for seed in range(1000)]
    assert not any(values)


@given(
    row=st.integers(0, SIDE - 1),
    col=st.integers(0, SIDE - 1),
    side=st.integers(1, SIDE),
    force=st.floats(0.05, 2.5),
    has_come=st.booleans(),
)
def test_a_press_that_comes_or_goes_is_no_offset(row, col, side, force, has_come):
    frame = np.zeros((1, SIDE, SIDE), dtype=np.float32)
    frame[0, row : row + side, col : col + side] = force
    y = PHI.forward(noisy(frame)[0].reshape(-1))
    watch = OffsetWatch(LEAST_SD)
    assert watch.look(PHI, y if has_come else -y) == 0.0


@given(data=st.data(), offset=st.floats(0.05, 30.0), sign=st.sampled_from([-1, 1]))
def test_a_change_of_some_blocks_alone_is_no_offset(data, offset, sign):
    watch = OffsetWatch(LEAST_SD)
    rows = watch.rows_of(PHI)
    blocks = range(len(rows.starts))
    changed = data.draw(
        st.sets(st.sampled_from(blocks), min_size=1, max_size=len(blocks) - 1)
    )
    change = np.where(np.isin(rows.block, [*changed]), np.float32(sign * offset), 0)
    assert watch.look(PHI, innovation(0) + change) == 0.0


@pytest.mark.parametrize(
    ("side", "is_told_apart"), [(16, False), (32, True), (40, True)]
)
@pytest.mark.parametrize("ratio", [2, 3, 8])
def test_an_offset_is_told_from_forces_on_skins_of_four_blocks(
    side, ratio, is_told_apart
):
    watch = OffsetWatch(LEAST_SD)
    for phi in row_subsets(
        make_phi("sbhe", side**2, side**2 // ratio, seed=0), ROTATING
    ):
        assert watch.rows_of(phi).is_told_apart == is_told_apart


def test_on_a_skin_of_one_block_no_offset_is_subtracted():
    phi = make_phi("sbhe", 256, 85, seed=0)
    assert OffsetWatch(LEAST_SD).look(phi, np.full(85, 0.5, dtype=np.float32)) == 0.0


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
@pytest.mark.parametrize("offset", [-0.7, 0.1, 5.0])
def test_frames_with_an_offset_are_those_without(rows, offset):
    edge, plain, spoilt = (
        Stream((SIDE, SIDE), rows=rows, sigmas=SIGMAS) for _ in range(3)
    )
    for k, frame in enumerate(noisy(DISC)):
        y = edge.compress(frame)
        expected = plain.reconstruct(y)
        added = np.float32(offset) if 20 <= k < 40 else np.float32(0)
        found = spoilt.reconstruct(y + added)
        if k < 20:
            continue
        error = np.linalg.norm(found - DISC[k]) / np.linalg.norm(DISC[k])
        assert error < 1.5 * np.linalg.norm(expected - DISC[k]) / np.linalg.norm(
            DISC[k]
        )
        assert spoilt.trusted == plain.trusted
