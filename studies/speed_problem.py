"""The problem that the project's FISTA and other libraries are given alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.phi import Phi, make_phi
from sparseskin.nodes.reconstructor.basis import Basis, make_basis
from sparseskin.nodes.reconstructor.fista import FistaSolver
from sparseskin.nodes.reconstructor.parameters import MAX_ITERATIONS

from .scene_frames import Floats


class Bpdn:
    """min over theta of 1/2 ||A theta - y||^2 + lambda ||theta||_1, A = Phi Psi.

    A is the project's own operators, for Haar and SBHE: ||A|| = 1.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the grid, every cell a taxel.
    ratio : int
        N / M.
    seed : int
        Of Phi.
    lambda_n : float
        In newtons, for orthonormal rows.

    Attributes
    ----------
    n, m : int
        A is m x n.
    """

    def __init__(self, shape: tuple[int, int], ratio: int, seed: int, lambda_n: float) -> None:
        self.grid = shape
        self.n = shape[0] * shape[1]
        self.m = self.n // ratio
        self.lambda_n = lambda_n
        self.phi: Phi = make_phi("sbhe", n=self.n, m=self.m, seed=seed)
        self.basis: Basis = make_basis("haar", *shape)

    def forward(self, theta: Any) -> Floats:
        """A theta: shape (n,) to (m,)."""
        return self.phi.forward(self.basis.synthesis(theta.reshape(self.grid)).reshape(-1))

    def adjoint(self, y: Any) -> Floats:
        """A^T y: shape (m,) to (n,)."""
        return self.basis.analysis(self.phi.adjoint(y).reshape(self.grid)).reshape(-1)

    def dense(self) -> npt.NDArray[np.float64]:
        """A as a matrix, float64, shape (m, n)."""
        rows = np.eye(self.m, dtype=np.float32)
        return np.stack([self.adjoint(row) for row in rows]).astype(np.float64)

    def objective(self, theta: Any, y: Floats) -> float:
        """The value that is minimised, in newtons squared (theta in newtons)."""
        misfit = self.forward(theta).astype(np.float64) - y
        l1 = np.abs(theta, dtype=np.float64).sum()
        return float(0.5 * misfit @ misfit + self.lambda_n * l1)

    def image(self, theta: Any) -> Floats:
        """Forces that belong to theta, negative ones set to 0: shape (n_rows, n_cols)."""
        return np.maximum(self.basis.synthesis(theta.reshape(self.grid)), 0)

    def fista(self, iterations: int) -> FistaSolver:
        """The project's FISTA for this problem."""
        return FistaSolver(self.phi, self.basis, iterations=iterations, lambda_n=self.lambda_n)

    def solution(self, y: Floats) -> Floats:
        """Theta after 1000 iterations, shape (n,): as good as the minimum."""
        solver = self.fista(MAX_ITERATIONS)
        solver.solve(y)
        return solver.theta.reshape(-1)
