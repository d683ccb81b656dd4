"""Iterative soft thresholding, what FISTA is without its momentum."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.image_solver import ImageSolver
from sparseskin.nodes.reconstructor.parameters import newtons
from sparseskin.nodes.reconstructor.solver import Mask


class IstaSolver(ImageSolver):
    """min over theta of 1/2 ||Phi R Psi theta - y||^2 + lambda ||theta||_1, then x = Psi theta.

    theta <- soft(theta + Psi^T Phi^T (y - Phi Psi theta) / L, lambda / L), from the theta of the
    last frame. Here to be compared with.

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
    Source: Daubechies, Defrise, De Mol, "An iterative thresholding algorithm for linear inverse
    problems with a sparsity constraint", Comm. Pure Appl. Math. 57(11), 2004.
    """

    name = "ista"

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int = 50,
        lambda_n: float = 0.1 / 32,
    ) -> None:
        super().__init__(phi, basis, mask, iterations=iterations)
        self.lambda_n = newtons(self.name, "lambda_n", lambda_n)
        self._limit = np.float32(self.lambda_n * self._projection.step_size)
        self._theta: Floats = np.zeros_like(self._image)
        self._clipped: Floats = np.zeros_like(self._image)

    def _begin(self) -> None:
        pass

    def _iterate(self) -> None:
        self._descend(self._image)
        np.add(self._gradient, self._image, self._gradient)
        self.basis.analysis(self._gradient, self._theta)
        np.clip(self._theta, -self._limit, self._limit, out=self._clipped)
        np.subtract(self._theta, self._clipped, self._theta)
        self.basis.synthesis(self._theta, self._image)
