"""What a user would try first: single taxels, a filter of all taxels, packed frames."""

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.quadtree import Quadtree
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.baselines.sampling import (
    CODECS,
    NEWEST,
    Codec,
    Filtered,
    Lattice,
    acts_values,
    adaptive_values,
    address_bytes,
    classes,
)
from sparseskin.studies.evaluate import VALUE_BYTES

SHAPE = (12, 10)
EVERY = np.ones(SHAPE, np.bool_)


def press(row):
    """A smooth press at a row."""
    i, j = np.indices(SHAPE)
    frame = 50 * np.exp(-((i - row) ** 2 + (j - 5) ** 2) / 6)
    return np.where(frame > 1, frame, 0).astype(np.float32)


def still(force_n, n=40):
    truth = np.full((8, 8), force_n, dtype=np.float32)
    rng = np.random.default_rng(0)
    return [NoiseModel().apply(truth, rng) for _ in range(n)]


@pytest.mark.parametrize("k", [2, 3, 16])
@pytest.mark.parametrize("shape", [(1, 16), (31, 11)])
def test_classes_hold_every_taxel_once_and_are_of_equal_density(shape, k):
    mask = np.ones(shape, dtype=np.bool_)
    mask[0, :2] = False
    members = classes(mask, k)
    assert np.array_equal(np.sort(np.concatenate(members)), np.flatnonzero(mask))
    assert len(members) == k
    assert max(one.size for one in members) <= mask.size / k + max(shape)


def test_the_lattice_reproduces_a_plane_between_its_taxels_with_its_share_of_values():
    i, j = np.indices((16, 16))
    plane = (1 + 2 * i + 3 * j).astype(np.float32)
    solved = Lattice(np.ones((16, 16), dtype=np.bool_), 4).reconstruct(plane)
    assert solved.n_bytes == 64 * VALUE_BYTES
    assert np.abs((solved.forces - plane)[3:-3, 3:-3]).max() < 1e-3


def test_the_lattice_reads_no_cell_without_a_taxel_even_if_few_exist():
    mask = np.zeros((8, 8), dtype=np.bool_)
    mask[::2, ::2] = True
    taxels = np.where(mask, np.float32(3), np.float32(np.nan))
    for ratio in (3, 4, 8):
        solved = Lattice(mask, ratio).reconstruct(taxels)
        assert solved.n_bytes <= VALUE_BYTES * -(-16 // ratio)
        assert (solved.forces == np.where(mask, 3, 0)).all()


def test_the_filter_halves_the_noise_of_a_still_force():
    frames, kept = still(1.25), Filtered(NoiseModel())
    last = [kept.reconstruct(frame).forces for frame in frames][-1]
    # Of a running mean of weight w, the variance is w / (2 - w).
    expected = np.std(frames[-1]) * np.sqrt(NEWEST / (2 - NEWEST))
    assert np.std(last) == pytest.approx(expected, rel=0.3)


def test_the_filter_follows_a_jump_at_once_and_leaves_its_input_as_it_is():
    kept = Filtered(NoiseModel())
    for frame in still(0.0):
        assert kept.reconstruct(frame).forces.max() < 0.1
    pressed = still(1.0, 1)[0]
    before = pressed.copy()
    np.testing.assert_allclose(kept.reconstruct(pressed).forces, pressed, rtol=1e-6)
    np.testing.assert_array_equal(pressed, before)


@pytest.mark.parametrize("kind", CODECS)
def test_codecs_keep_eight_bits_and_state_their_size(kind):
    codec = Codec(EVERY, 50.0, kind)
    for frame in (press(5), press(5.5), np.zeros(SHAPE, np.float32)):
        assert np.abs(codec.reconstruct(frame).forces - frame).max() <= 0.5001 * 50 / 255
    codec.reconstruct(np.zeros(SHAPE, np.float32))
    assert codec.reconstruct(np.zeros(SHAPE, np.float32)).n_bytes < 30


def test_touched_taxels_cost_a_byte_each_and_a_bit_a_taxel():
    codec = Codec(np.ones((8, 8), dtype=np.bool_), 1.0, "touched")
    frame = np.zeros((8, 8), dtype=np.float32)
    assert codec.reconstruct(frame).n_bytes == 0
    frame[:3] = 1
    assert codec.reconstruct(frame).n_bytes == 24 + 8


@pytest.mark.parametrize(("n", "ratio"), [(16, 3), (228, 4), (4096, 8)])
def test_single_taxels_with_addresses_fill_the_bytes_of_the_measurements(n, ratio):
    m = n // ratio
    values = acts_values(n, m)
    assert VALUE_BYTES * values + address_bytes(n, values) <= VALUE_BYTES * m
    assert VALUE_BYTES * (values + 1) + address_bytes(n, values + 1) > VALUE_BYTES * m


@pytest.mark.parametrize(("shape", "ratio"), [((4, 8), 3), ((19, 12), 8), ((64, 64), 8)])
def test_adaptive_rows_and_their_code_fit_into_the_bytes_of_the_measurements(shape, ratio):
    mask = np.ones(shape, dtype=np.bool_)
    m = mask.size // ratio
    values = adaptive_values(mask, m)
    assert 2 * m / 3 < values < m
    tree = Quadtree(mask, values)
    assert VALUE_BYTES * values + tree.most_code_bytes(values - tree.n_tiles) <= VALUE_BYTES * m
