"""Shifted Haar: orthonormal under every shift, on every grid, and the Haar of the article."""

from __future__ import annotations

import numpy as np
import pytest

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.numerics.programs import run
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.bases.shifted_haar import SHIFTS, ShiftedHaar


class Transform:
    """T and its way back on buffers, for vectors of taxels in a random order."""

    def __init__(self, shape: tuple[int, int], n_missing: int = 0) -> None:
        rng = np.random.default_rng(0)
        cells = shape[0] * shape[1]
        self.n = cells - n_missing
        self.place_of_cell = np.full(cells, self.n)
        self.place_of_cell[rng.permutation(cells)[: self.n]] = rng.permutation(self.n)
        self.haar = ShiftedHaar(shape, self.place_of_cell.reshape(shape), self.n)
        self.x, self.c, scratch = (np.zeros(self.haar.size, dtype=np.float32) for _ in range(3))
        self._to_c = self.haar.analysis(self.x, self.c, scratch)
        self._to_x = self.haar.synthesis(self.c, self.x, scratch)

    def analysis(self, taxels: Floats, shift: int) -> Floats:
        self.x[:] = np.append(taxels, np.float32(0))[self.haar.tables(shift)[0]]
        run(self._to_c)
        scaled: Floats = self.c * np.sqrt(self.haar.weights2)
        return scaled

    def synthesis(self, coefficients: Floats, shift: int) -> Floats:
        self.c[:] = coefficients * np.sqrt(self.haar.weights2)
        run(self._to_x)
        return self.x[self.haar.tables(shift)[1]]


GRIDS = [((8, 8), 0), ((40, 40), 0), ((33, 47), 30), ((12, 32), 5), ((1, 5), 0)]


@pytest.mark.parametrize(("shape", "n_missing"), GRIDS)
def test_every_shift_is_orthonormal_and_undone_by_its_transpose(
    shape: tuple[int, int], n_missing: int
) -> None:
    transform = Transform(shape, n_missing)
    rng = np.random.default_rng(1)
    x = rng.normal(size=transform.n).astype(np.float32)
    v = rng.normal(size=transform.haar.size).astype(np.float32)
    for shift in range(len(SHIFTS)):
        c = transform.analysis(x, shift)
        assert float(c @ c) == pytest.approx(float(x @ x), rel=1e-5)
        assert float(c @ v) == pytest.approx(float(x @ transform.synthesis(v, shift)), abs=1e-3)
        np.testing.assert_allclose(transform.synthesis(c, shift), x, atol=1e-5)


def test_a_tile_has_the_coefficients_of_the_haar_basis() -> None:
    transform = Transform((8, 8))
    image = np.random.default_rng(2).normal(size=(8, 8)).astype(np.float32)
    taxels = np.empty(64, dtype=np.float32)
    taxels[transform.place_of_cell] = image.ravel()
    unshifted = SHIFTS.index((0, 0))
    ours = np.sort(np.abs(transform.analysis(taxels, unshifted)))
    expected = np.sort(np.abs(HaarBasis(8, 8).analysis(image).ravel()))
    np.testing.assert_allclose(ours, expected, atol=1e-5)


def test_shifts_put_an_edge_on_every_row_and_column_of_a_tile() -> None:
    assert {row for row, _ in SHIFTS} == {col for _, col in SHIFTS} == set(range(8))
    assert len(set(SHIFTS)) == len(SHIFTS)
