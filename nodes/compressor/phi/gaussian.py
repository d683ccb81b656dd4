"""A dense matrix of normal random numbers: the reference of compressed sensing theory."""

import math
from functools import cached_property

import numpy as np

from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.numerics.arrays import Doubles, Floats

from .base import BLOCK, Phi, fingerprint_of

N_MAX = 4096
"""Largest number of taxels: the matrix then takes 64 MiB at most."""


class GaussianPhi(Phi):
    """Entries independent, normal, mean 0, standard deviation 1 / sqrt(n).

    A row has a squared length of 1 in the mean, as the rows of the other kinds have. The rows are
    not made orthonormal: the matrix, and so its fingerprint, would depend on the rounding of a
    linear algebra library. `lipschitz` is therefore more than 1: near (1 + sqrt(m / n))^2.

    Raises PhiError also if n is over 4096: the matrix is dense.

    Source: the paper, section IV-B, as the matrix that theory favours and wiring forbids.
    """

    kind = "gaussian"

    @classmethod
    def check_size(cls, n: int, m: int, seed: int, block: int) -> None:
        super().check_size(n, m, seed, block)
        if n > N_MAX:
            allowed = f"1..{N_MAX} (dense matrix)"
            raise PhiError(
                f'phi "gaussian": n = {n} is not allowed; allowed: {allowed}'
            )

    def __init__(self, n: int, m: int, seed: int, block: int = BLOCK) -> None:
        super().__init__(n, m, seed, block)
        # In float64: a float32 generator would draw other numbers.
        rng = np.random.default_rng(seed)
        matrix = rng.standard_normal((m, n)) / math.sqrt(n)
        self.matrix: Floats = matrix.astype(np.float32)
        self.matrix.setflags(write=False)
        self.fingerprint = fingerprint_of(self.kind, n, m, 1, self.matrix)

    @cached_property
    def lipschitz(self) -> float:
        """Largest eigenvalue of Phi Phi^T, rounded up in the sixth decimal.

        The last bits of a linear algebra library then do not reach the solver's step size.
        """
        rows = self.dense()
        # In ascending order.
        eigenvalues = np.linalg.eigvalsh(rows @ rows.T)
        largest = float(eigenvalues[-1])
        return math.ceil(largest * 1e6) / 1e6

    def dense(self) -> Doubles:
        """Return the explicit matrix, float64, shape (m, n)."""
        return self.matrix.astype(np.float64)

    def _forward(self, x: Floats, out: Floats) -> None:
        # einsum adds in numpy, always in one order; the order of a matmul depends on the BLAS.
        np.einsum("ij,j->i", self.matrix, x, out=out)

    def _adjoint(self, y: Floats, out: Floats) -> None:
        np.einsum("ij,i->j", self.matrix, y, out=out)
