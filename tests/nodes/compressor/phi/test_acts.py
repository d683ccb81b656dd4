"""Adaptive sampling: the choice of taxels, and how it travels with their readings."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matrices import grids

from sparseskin.messages import Measurements, MessageError
from sparseskin.nodes.compressor.phi.acts import ActsSearch, packed_places
from sparseskin.nodes.compressor.phi.adaptive import follow
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.errors import PhiError

THRESHOLD = 0.05


def everywhere(*shape):
    return np.ones(shape, np.bool_)


def read_cells(image, m):
    """The cells that a search reads of a frame."""
    search = ActsSearch(everywhere(*image.shape), m, THRESHOLD)
    is_read = np.zeros(image.size, np.bool_)
    is_read[search.places(image.reshape(-1).take)] = True
    return is_read.reshape(image.shape)


@given(exists=grids(), data=st.data())
def test_m_existing_taxels_are_read_each_once_on_any_grid(exists, data):
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    n = int(exists.sum())
    m = data.draw(st.integers(1, n))
    x = np.maximum(rng.normal(-0.5, 1, n), 0).astype(np.float32)
    asked = []

    def read(taxels):
        asked.extend(taxels)
        return x.take(taxels)

    places = ActsSearch(exists, m, THRESHOLD).places(read)
    assert len(asked) == len(set(asked)) == m
    np.testing.assert_array_equal(places, np.sort(asked))
    assert places[0] >= 0
    assert places[-1] < n


def test_an_untouched_skin_is_read_evenly():
    is_read = read_cells(np.zeros((64, 64), np.float32), 64 * 64 // 16)
    for part in is_read.reshape(8, 8, 8, 8).swapaxes(1, 2).reshape(-1, 64):
        assert part.sum() == 4


def test_the_taxels_of_a_contact_and_around_it_are_all_read_where_m_allows():
    image = np.zeros((40, 40), np.float32)
    image[17:24, 5:12] = 1.0
    is_read = read_cells(image, 400)
    assert is_read[16:25, 4:13].all()


@pytest.mark.parametrize("m", [0, 101])
def test_more_readings_than_taxels_are_refused(m):
    with pytest.raises(PhiError, match=rf"acts: m = {m} is not allowed; allowed: 1\.\.100"):
        ActsSearch(everywhere(10, 10), m, THRESHOLD)


def test_what_is_read_are_the_taxels_that_were_chosen():
    phi = make_phi("acts", 100, 4, seed=0)
    taxels = np.array([0, 7, 50, 99])
    follow(phi, packed_places(taxels, 100), None)
    x = np.arange(100, dtype=np.float32)
    np.testing.assert_array_equal(phi.forward(x), [0, 7, 50, 99])
    np.testing.assert_array_equal(phi.dense() @ x, phi.forward(x))
    y = np.array([1, 2, 3, 4], np.float32)
    np.testing.assert_array_equal(phi.adjoint(y), phi.dense().T @ y)
    # The fingerprint is of n and m alone.
    assert phi.fingerprint == make_phi("acts", 100, 4, seed=9).fingerprint
    assert phi.fingerprint != make_phi("acts", 100, 5, seed=0).fingerprint


@pytest.mark.parametrize(
    ("kind", "places", "text"),
    [
        ("acts", None, "come without the places"),
        ("acts", packed_places(np.arange(3), 100), "3 taxels are read; expected m = 4"),
        ("acts", packed_places(np.array([0, 1, 2, 103]), 104), r"not ascending within 0\.\.99"),
        ("subsample", packed_places(np.arange(4), 100), 'allowed: phi "acts" alone'),
    ],
)
def test_places_that_do_not_fit_are_refused(kind, places, text):
    with pytest.raises(PhiError, match=text):
        follow(make_phi(kind, 100, 4, seed=0), places, None)
    y = np.ones(4, np.float32)
    with pytest.raises(MessageError, match="places: 3 of them for 4 measurements"):
        Measurements(stamp_ns=1, patch="skin", y=y, phi="0" * 16, places=np.uint8([7]))
