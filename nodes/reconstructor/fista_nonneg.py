"""FISTA that knows, in every iteration, that a skin is pressed and never pulled."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.image_solver import ImageSolver
from sparseskin.nodes.reconstructor.parameters import newtons
from sparseskin.nodes.reconstructor.solver import Mask


class FistaNonnegSolver(ImageSolver):
    """min over x >= 0 of 1/2 ||Phi x - y||^2 + lambda ||Psi^T x||_1.

    x <- max(0, Psi soft(Psi^T (z - gradient / L), lambda / L)), with FISTA's momentum. Shrinking
    first and cutting off then is not the exact proximal step of both terms together, which has
    no closed form; it is one step of alternating between them.

    Parameters
    ----------
    phi, basis, mask
        As in `Solver`.
    iterations : int
        1..1000.
    lambda_n : float
        Weight of the l1 norm, newtons, at least 0, for orthonormal rows of Phi.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.

    Notes
    -----
    Source: Beck, Teboulle, "Fast gradient-based algorithms for constrained total variation image
    denoising and deblurring problems", IEEE Trans. Image Processing 18(11), 2009, for momentum
    under a constraint.
    """

    name = "fista_nonneg"

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int = 20,
        lambda_n: float = 0.00625,
    ) -> None:
        super().__init__(phi, basis, mask, iterations=iterations)
        self.lambda_n = newtons(self.name, "lambda_n", lambda_n)
        #: What a coefficient is shrunk by; a subclass may have a limit for each of them.
        self._limit: Floats | np.float32 = np.float32(self.lambda_n * self._projection.step_size)
        self._z: Floats = np.zeros_like(self._image)
        self._theta: Floats = np.zeros_like(self._image)
        self._clipped: Floats = np.zeros_like(self._image)
        self._before: Floats = np.zeros_like(self._image)

    def _begin(self) -> None:
        np.copyto(self._z, self._image)
        self._t = 1.0

    def _iterate(self) -> None:
        x, z = self._image, self._z
        self._descend(z)
        np.add(self._gradient, z, self._gradient)
        self.basis.analysis(self._gradient, self._theta)
        np.clip(self._theta, -self._limit, self._limit, out=self._clipped)
        np.subtract(self._theta, self._clipped, self._theta)
        np.copyto(self._before, x)
        self.basis.synthesis(self._theta, x)
        np.maximum(x, 0, out=x)
        np.multiply(x, self._inside, x)

        t_next = (1 + math.sqrt(1 + 4 * self._t**2)) / 2
        np.subtract(x, self._before, z)
        np.multiply(z, np.float32((self._t - 1) / t_next), z)
        np.add(z, x, z)
        self._t = t_next
