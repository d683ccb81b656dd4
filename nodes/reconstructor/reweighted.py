"""Reweighted l1: a coefficient that the last frame had costs little to have again."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.fista_nonneg import FistaNonnegSolver
from sparseskin.nodes.reconstructor.solver import Mask

#: A coefficient of so many lambdas in the last frame has half its weight.
HALF = 3.0


class ReweightedSolver(FistaNonnegSolver):
    """min over x of 1/2 ||Phi x - y||^2 + lambda sum_i w_i |theta_i|, theta = Psi^T x.

    w_i = e / (e + |theta_i of the last frame|), e = 3 lambda (RWL1-DF with "the scene stays" for
    its dynamics): what was there is hardly shrunk, what was not has to show itself against the
    whole of lambda. FISTA with x >= 0 in each iteration; w is 1 in the first frame.

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
    Source: Charles, Balavoine, Rozell, "Dynamic filtering of time-varying sparse signals via l1
    minimization", IEEE Trans. Signal Processing 64(21), 2016.
    """

    name = "reweighted"

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int = 20,
        lambda_n: float = 0.0125,
    ) -> None:
        super().__init__(phi, basis, mask, iterations=iterations, lambda_n=lambda_n)

    def _begin(self) -> None:
        super()._begin()
        half = np.float32(HALF * self.lambda_n + 1e-30)
        last = np.abs(self.basis.analysis(self._image, self._theta))
        limit = np.float32(self.lambda_n * self._projection.step_size)
        self._limit = limit * half / (half + last)
