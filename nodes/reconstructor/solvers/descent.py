"""Iterations of FISTA on 1/2 ||Phi R Psi theta - y||^2 + lambda ||theta||_1."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.hadamard import HadamardProducts
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.numerics.programs import Call, gather, run
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis


class Descent(ABC):
    """Gradient steps of length 1/L, with momentum and shrinkage.

    Coefficients are held in an order and scale of the descent's own: w = weights * theta.

    Attributes
    ----------
    weights : ndarray of float32, shape (n_inner,)
    step_size : float
        1 / L.
    """

    weights: Floats
    step_size: float

    @abstractmethod
    def set_measurements(self, y: Floats) -> None:
        """Set the measurements of a frame: contiguous float32, shape (m,), newtons."""

    @abstractmethod
    def image_of(self, w: Floats, out: Floats) -> None:
        """Write the image of coefficients w to out, float32, shape (n_rows, n_cols)."""

    @abstractmethod
    def coefficients_of(self, image: Floats, out: Floats) -> None:
        """Write the coefficients of an image to out, float32, shape (n_inner,)."""

    @abstractmethod
    def prepare(self, thetas: Floats, threshold: Floats) -> None:
        """Set the buffers of `iterate`, shape (2, n_inner), and the thresholds of w, (n_inner,)."""

    @abstractmethod
    def iterate(self, newest: int, betas: Floats) -> None:
        """Do an iteration for each of the momenta betas, float32 (k,).

        z = theta + beta (theta - theta_before); u = z - gradient / L; the result is u after soft
        thresholding. It replaces theta_before, so that the buffers swap roles; `newest` is the
        number, 0 or 1, of the one that holds theta at first.
        """


class NumpyDescent(Descent):
    """Iterations as programs of calls on fixed buffers.

    `calls` do the gradient step from z, which they overwrite, to u: float32, shape (n_inner,).
    """

    z: Floats
    u: Floats
    calls: list[Call]

    def prepare(self, thetas: Floats, threshold: Floats) -> None:
        self._parts = np.zeros(2, dtype=np.float32)
        clipped = np.empty_like(threshold)
        self._iterations: list[list[Call]] = [
            [
                # theta + beta (theta - before), in one pass.
                (np.dot, (self._parts, thetas, self.z)),
                *self.calls,
                # soft(u) = u - clip(u). These two take no third argument by position.
                (partial(np.minimum, self.u, threshold, out=clipped), ()),
                (partial(np.maximum, clipped, -threshold, out=clipped), ()),
                (np.subtract, (self.u, clipped, before)),
            ]
            for before in thetas[::-1]
        ]

    def iterate(self, newest: int, betas: Floats) -> None:
        for beta in betas:
            self._parts[newest], self._parts[1 - newest] = 1 + beta, -beta
            run(self._iterations[newest])
            newest = 1 - newest


class PlainDescent(NumpyDescent):
    """The gradient step for any phi and any basis, through their public operators.

    The restriction R is `taxels`, intp (n,): the place in the flat grid of each existing taxel.
    """

    def __init__(self, phi: Phi, basis: Basis, taxels: Indices) -> None:
        self._phi, self._basis, self._taxels = phi, basis, taxels
        self.step_size = 1 / phi.lipschitz
        self._step = np.array(self.step_size, dtype=np.float32)
        grids = np.zeros((3, basis.n_rows, basis.n_cols), dtype=np.float32)
        self._z_grid, self._u_grid, self._image = grids
        self.z, self.u = self._z_grid.reshape(-1), self._u_grid.reshape(-1)
        self.weights = np.ones(self.z.size, dtype=np.float32)
        self._x = np.zeros(phi.n, dtype=np.float32)
        self._y, self._residual = np.zeros((2, phi.m), dtype=np.float32)
        self.calls = [(self._descend, ())]

    def set_measurements(self, y: Floats) -> None:
        np.copyto(self._y, y)

    def image_of(self, w: Floats, out: Floats) -> None:
        self._basis.synthesis(w.reshape(out.shape), out)

    def coefficients_of(self, image: Floats, out: Floats) -> None:
        self._basis.analysis(image, out.reshape(image.shape))

    def _descend(self) -> None:
        image, flat = self._image, self._image.reshape(-1)
        self._basis.synthesis(self._z_grid, image)
        flat.take(self._taxels, None, self._x, "clip")
        self._phi.forward(self._x, self._residual)
        np.subtract(self._y, self._residual, self._residual)
        np.multiply(self._residual, self._step, self._residual)
        self._phi.adjoint(self._residual, self._x)
        flat.fill(0)
        flat[self._taxels] = self._x
        self._basis.analysis(image, self._u_grid)
        np.add(self.u, self.z, self.u)


class SbheHaarDescent(NumpyDescent):
    """The gradient step for the scrambled block Hadamard ensemble and Haar, many times faster.

    With orthonormal rows L = 1, and the step replaces the measured Hadamard coefficients of the
    image by y and keeps the others. Both transforms run in their inner orders, as products with
    small matrices; one gather each way does the work of the permutation, the restriction and both
    reorderings.
    """

    def __init__(self, phi: SbhePhi, basis: HaarBasis, taxels: Indices) -> None:
        n_cells = basis.n_rows * basis.n_cols
        n = phi.n
        self._phi, self._basis = phi, basis
        self.step_size = 1.0
        self.weights = np.ones(basis.n_inner, dtype=np.float32)
        self.z = np.zeros(basis.n_inner, dtype=np.float32)
        self.u = np.zeros(basis.n_inner, dtype=np.float32)
        self._w = np.zeros(basis.n_inner, dtype=np.float32)
        self._x = np.zeros(n_cells, dtype=np.float32)
        self._to_x = basis.synthesis_program(self._w, self._x)
        self._to_w = basis.analysis_program(self._x, self._w)

        a = np.zeros(n_cells, dtype=np.float32)
        b = np.zeros(n_cells, dtype=np.float32)
        hadamard = HadamardProducts(phi.hadamard.sizes)
        transform, middle = hadamard.program(a, b)
        self._row_places = np.argsort(hadamard.order_out)[phi.rows]

        # Cells without a taxel stand behind the transform's n places, unchanged by it.
        absent = np.setdiff1d(np.arange(n_cells), taxels)
        order = np.concatenate([taxels[phi.permutation[hadamard.order_in]], absent])
        places = basis.place_of_pixel[order]
        # The transform is not scaled: there and back multiplies by the size of the block.
        keep: Floats = np.reciprocal(hadamard.size_at)
        keep[self._row_places] = 0
        self._measured = np.zeros(n, dtype=np.float32)
        self._scaled_y = np.zeros(phi.m, dtype=np.float32)

        self.calls = [
            *basis.synthesis_program(self.z, self._x),
            gather(self._x, places, a),
            *transform,
            (np.multiply, (middle[:n], keep, middle[:n])),
            (np.add, (middle[:n], self._measured, middle[:n])),
            *hadamard.transposed(a, b),
            gather(a, np.argsort(places), self._x),
            *basis.analysis_program(self._x, self.u),
        ]

    def set_measurements(self, y: Floats) -> None:
        np.multiply(y, self._phi.scale, self._scaled_y)
        self._measured[self._row_places] = self._scaled_y

    def image_of(self, w: Floats, out: Floats) -> None:
        np.copyto(self._w, w)
        run(self._to_x)
        self._x.take(self._basis.place_of_pixel, None, out.reshape(-1), "clip")

    def coefficients_of(self, image: Floats, out: Floats) -> None:
        image.reshape(-1).take(self._basis.order, None, self._x, "clip")
        run(self._to_w)
        np.copyto(out, self._w)
