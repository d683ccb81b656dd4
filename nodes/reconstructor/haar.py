"""The two-dimensional Haar basis at full depth, on a grid of any size."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Call, Floats, Indices, gather, run
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.halving import Halvings


class HaarBasis(Basis):
    """Psi = the orthonormal 2-D Haar (Daubechies D2) basis, full depth.

    At each level neighbours are paired along both axes: (a + b) / sqrt(2) goes on to the next
    level, (a - b) / sqrt(2) is a detail. The last sample of an odd side goes on unchanged. A
    side of 1 is done while the other goes on. Coefficients are laid out as a pyramid: at each
    level the approximation top left, details along the columns' direction (axis 1) to its
    right, along the rows' (axis 0) below it, along both diagonally.

    Where a side is odd, or gets odd after some halvings, the rest is padded to powers of two
    inside, so such sizes (33 x 33) cost as much as the next power of two.

    Parameters
    ----------
    n_rows, n_cols : int
        Size of the grid of taxels.

    Attributes
    ----------
    order : ndarray of intp, shape (n_rows * n_cols,)
        Place p of an inner image buffer holds the pixel order[p] of the flat image.
    place_of_pixel : ndarray of intp, shape (n_rows * n_cols,)
        The inverse: pixel i of the flat image stands at place place_of_pixel[i].
    n_inner : int
        Length of an inner coefficient buffer, the padding included.
    weights : ndarray of float32, shape (n_inner,)
        The inner transform T only adds and subtracts: theta = weights * T image. Weight 0: a
        place of the padding, no coefficient.

    Raises
    ------
    SolverError
        If the grid is empty.

    Notes
    -----
    Source: the paper, section IV-A. Scaling once at the end, not at each level, changes no bit
    on sides of powers of two: the weights are powers of two.
    """

    def __init__(self, n_rows: int, n_cols: int) -> None:
        super().__init__(n_rows, n_cols)
        # First as many halvings as come out even; what is left is padded and halved on.
        self._even = Halvings((n_rows, n_cols))
        rest = self._even.shapes[-1]
        padded = (_next_power_of_two(rest[0]), _next_power_of_two(rest[1]))
        self._padded = Halvings(padded)
        self.order: Indices = self._even.order
        self.n_inner: int = max(self._even.n_inner + self._padded.n_inner, 1)

        gain = np.outer(_gains(rest[0], padded[0]), _gains(rest[1], padded[1]))
        i, j = np.divmod(self._padded.order, padded[1])
        inside = (i < rest[0]) & (j < rest[1])
        rest_places = self._even.last_places if self._even.depth else np.arange(rest[0] * rest[1])
        sample = np.where(inside, i * rest[1] + j, 0)
        self._pad: Indices = rest_places[sample]
        self._pad_gain: Floats = gain.reshape(-1)[self._padded.order].astype(np.float32)
        self._unpad: Indices = np.flatnonzero(inside)[np.argsort(sample[inside])]
        self._unpad_gain: Floats = self._pad_gain[self._unpad]

        even = self._even.bands((n_rows, n_cols), np.ones((n_rows, n_cols)), n_cols)
        deep = self._padded.bands(rest, gain**2 * (n_rows * n_cols / (rest[0] * rest[1])), n_cols)
        if deep.cells.size:
            even.cells[self._even.last_places] = -1
        cells = np.concatenate([even.cells, deep.cells])
        energies = np.concatenate([even.energies, deep.energies])
        if not cells.size:  # a single taxel is its own coefficient
            cells, energies = np.zeros(1, dtype=np.intp), np.ones(1)
        real = cells >= 0
        self.weights: Floats = np.zeros(self.n_inner, dtype=np.float32)
        self.weights[real] = 1 / np.sqrt(energies[real])
        self._cell_of_place: Indices = np.where(real, cells, 0)
        self._place_of_cell: Indices = np.flatnonzero(real)[np.argsort(cells[real])]

        self.place_of_pixel: Indices = np.argsort(self.order)
        self._x = np.empty(self.order.size, dtype=np.float32)
        self._c = np.empty(self.n_inner, dtype=np.float32)
        self._to_c = self.analysis_program(self._x, self._c)
        self._to_x = self.synthesis_program(self._c, self._x)

    def analysis_program(self, x: Floats, c: Floats) -> list[Call]:
        """Return the calls that compute c = T x.

        Parameters
        ----------
        x : ndarray of float32, shape (n_rows * n_cols,)
            Image in the inner `order`; left as it is.
        c : ndarray of float32, shape (n_inner,)
            Unscaled coefficients: `weights` * c are the coefficients.
        """
        if self.order.size == 1:
            return [(np.copyto, (c, x))]
        even_c, padded_c = c[: self._even.n_inner], c[self._even.n_inner :]
        calls = self._even.analysis(x, even_c)
        if self._padded.depth:
            d = np.empty(self._pad.size, dtype=np.float32)
            calls.append(gather(even_c if self._even.depth else x, self._pad, d))
            calls.append((np.multiply, (d, self._pad_gain, d)))
            calls += self._padded.analysis(d, padded_c)
        return calls

    def synthesis_program(self, c: Floats, x: Floats) -> list[Call]:
        """Return the calls that compute x = T^T c.

        Parameters
        ----------
        c : ndarray of float32, shape (n_inner,)
            `weights` * coefficients; overwritten.
        x : ndarray of float32, shape (n_rows * n_cols,)
            Image in the inner `order`.
        """
        if self.order.size == 1:
            return [(np.copyto, (x, c))]
        even_c, padded_c = c[: self._even.n_inner], c[self._even.n_inner :]
        calls: list[Call] = []
        if self._padded.depth:
            d = np.empty(self._pad.size, dtype=np.float32)
            rest = np.empty(self._unpad.size, dtype=np.float32)
            calls += self._padded.synthesis(padded_c, d)
            calls.append(gather(d, self._unpad, rest))
            target = self._even.last(even_c) if self._even.depth else x
            calls.append((np.multiply, (rest, self._unpad_gain, target)))
        calls += self._even.synthesis(even_c, x)
        return calls

    def _analysis(self, image: Floats, out: Floats) -> None:
        image.take(self.order, None, self._x, "clip")
        run(self._to_c)
        np.multiply(self._c, self.weights, self._c)
        self._c.take(self._place_of_cell, None, out, "clip")

    def _synthesis(self, coefficients: Floats, out: Floats) -> None:
        coefficients.take(self._cell_of_place, None, self._c, "clip")
        np.multiply(self._c, self.weights, self._c)
        run(self._to_x)
        self._x.take(self.place_of_pixel, None, out, "clip")


def _next_power_of_two(size: int) -> int:
    return 1 << (size - 1).bit_length()


def _gains(size: int, padded: int) -> npt.NDArray[np.float64]:
    """Return what each sample of one axis is multiplied by, so that sums need no more scaling.

    A pair's sum is sqrt(2) times its approximation; an unpaired sample has to be as large,
    sqrt(2) for each level at which it, or the sum it went into, is left over. The padding gets
    0. Shape (padded,).
    """
    sample = np.arange(padded)
    gains = np.where(sample < size, 1.0, 0.0)
    left, level = size, 0
    while left > 1:
        if left % 2:
            gains[sample >> level == left - 1] *= np.sqrt(2)
        left = (left + 1) // 2
        level += 1
    return gains
