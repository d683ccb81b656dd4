"""Taxels that a tare finds still: those that are, and no others."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sparseskin.messages.skin import Skin
from sparseskin.nodes.sensor.calibration.chain import TARE_FRAMES, Chain
from sparseskin.nodes.sensor.calibration.description import SkinDescription
from sparseskin.nodes.sensor.repetition import (
    CHANCE,
    QUIETER,
    needed_repetitions,
    still_taxels,
)
from sparseskin.nodes.sensor.zero import Zero

SEEDS = st.integers(0, 2**32 - 1)


def untouched(seed, shape, sd, step):
    """Readings of an untouched skin, float32, with noise, in steps of a converter."""
    rng = np.random.default_rng(seed)
    offsets = rng.uniform(200, 3800, shape)
    readings = offsets + rng.normal(0, sd, (TARE_FRAMES, *shape))
    if step:
        readings = step * np.round(readings / step)
    return readings.astype(np.float32)


@given(st.integers(0, 1000), st.integers(1, 1000))
def test_so_many_repetitions_have_the_chance_or_none_do(n_repeated, n_others):
    n_pairs = n_repeated + n_others
    needed = needed_repetitions(n_repeated, n_pairs)
    probability = QUIETER * (n_repeated + 1) / (n_pairs + 1)
    if math.isinf(needed):
        assert probability >= 0.9
        return
    assert probability**needed <= CHANCE
    assert probability ** (needed - 1) > CHANCE


@given(
    SEEDS,
    st.tuples(st.integers(4, 12), st.integers(4, 12)),
    st.floats(0.01, 40),
    st.sampled_from([0, 1, 4]),
    st.sets(st.integers(0, 11), max_size=4),
)
@settings(max_examples=60)
def test_a_dead_taxel_is_named_and_no_other(seed, shape, sd, step, dead):
    readings = untouched(seed, shape, sd, step)
    works = np.ones(shape, np.bool_)
    expected = np.zeros(shape, np.bool_)
    for cell in dead:
        readings[:, cell % shape[0], cell % shape[1]] = readings[0].flat[cell]
        expected[cell % shape[0], cell % shape[1]] = True
    found = still_taxels(readings, works)
    # Noise of less than three steps may stand still by itself.
    if sd > 4 * step:
        np.testing.assert_array_equal(found, expected)
    else:
        assert not (found & ~expected).any()


@given(SEEDS, st.floats(0.0, 1.0), st.floats(3, 30))
@settings(max_examples=40)
def test_what_a_converter_clips_at_its_end_is_not_still(seed, part, sd):
    # Some taxels rest below the lowest reading, some flicker at it, and some are above.
    rng = np.random.default_rng(seed)
    shape = (8, 8)
    offsets = np.where(rng.random(shape) < part, rng.uniform(-9, 2, shape), 9) * sd
    noise = rng.normal(0, sd, (TARE_FRAMES, *shape))
    readings = np.maximum(np.round(offsets + noise), 0)
    is_flickering = (readings == 0).mean(axis=0)
    found = still_taxels(readings, np.ones(shape, np.bool_))
    if ((is_flickering > 0.25) & (is_flickering < 1)).any():
        assert not found.any()
    assert not found[offsets > 0].any()


@given(SEEDS, st.integers(0, 35))
@settings(max_examples=20)
def test_a_tare_names_a_dead_taxel_in_its_line(seed, cell):
    shape = (6, 6)
    readings = untouched(seed, shape, 10.0, 1)
    row, col = divmod(cell, 6)
    readings[:, row, col] = 17
    lines = []
    skin = SkinDescription("palm", *shape, 4095.0)
    chain = Chain(skin, 0.0, TARE_FRAMES, lines.append)
    for k, frame in enumerate(readings):
        chain.process(frame, k)
    (line,) = lines
    assert line.endswith(f"; stuck taxels, whose force stays 0: ({row}, {col})")
    # The next tare, without it.
    lines.clear()
    chain.tare(untouched(seed + 1, shape, 10.0, 1))
    (line,) = lines
    assert "stuck" not in line


@given(SEEDS, st.integers(0, 35), st.booleans())
@settings(max_examples=20)
def test_a_program_is_warned_of_a_taxel_that_is_dead_in_its_tare(seed, cell, is_dead):
    readings = untouched(seed, (6, 6), 10.0, 1)
    if is_dead:
        readings[:, cell // 6, cell % 6] = 17
    zero = Zero(Skin(6, 6, 4095.0), tare=TARE_FRAMES)
    lines = []
    for frame in readings:
        zero.forces(frame)
        lines.append(zero.take_still())
    expected = ""
    if is_dead:
        expected = f"stuck taxels, whose force stays 0: {divmod(cell, 6)}"
    assert lines[-1] == expected
    assert not any(lines[:-1])
    assert zero.take_still() == ""
