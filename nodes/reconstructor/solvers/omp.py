"""Orthogonal matching pursuit: one coefficient after the other, down to the noise level."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import Basis

from .base import MAX_ITERATIONS, Solver, whole_number


class OmpSolver(Solver):
    """Greedy selection: each step adds the coefficient most correlated with the residual.

    It stops where no correlation exceeds that of noise as large as the residual r:
    max |A^T r| <= sqrt(2 ln n) sqrt(m / n) rms(r), A = Phi R Psi; further steps then do nothing.
    So the sparsity is found, not stated. Nothing is carried from frame to frame. Negative forces
    of the final image are set to 0.

    A step takes two transforms and a product with all atoms so far: milliseconds a frame for
    tens of coefficients. For comparison.

    Parameters
    ----------
    phi, basis, mask
        As in `Solver`.
    iterations : int
        Most coefficients of a frame, 1..1000; never more than measurements.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.

    Notes
    -----
    Source: Pati, Rezaiifar, Krishnaprasad, "Orthogonal matching pursuit", Asilomar 1993; Tropp,
    Gilbert, "Signal recovery from random measurements via orthogonal matching pursuit", IEEE
    Trans. Information Theory 53(12), 2007.
    """

    name = "omp"

    def __init__(
        self, phi: Phi, basis: Basis, mask: Mask | None = None, *, iterations: int = 100
    ) -> None:
        super().__init__(phi, basis, mask)
        self.iterations = whole_number("omp", "iterations", iterations, 1, MAX_ITERATIONS)
        self.n_steps = min(self.iterations, phi.m)
        noise = 2 * math.log(max(basis.n_rows * basis.n_cols, 2)) * phi.m / phi.n
        self._stands_out = math.sqrt(noise)
        self._theta: Floats = np.zeros(self.mask.shape, dtype=np.float32)

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        """Begin a frame; parameters and Raises as in `solve`. A warm start is not used."""
        self._y = self._checked_y(y).astype(np.float64)
        if warm is not None:
            self._checked_warm(warm)
        self._residual = self._y
        self._support: list[int] = []
        self._atoms = np.empty((0, self.phi.m))
        self._found = np.empty(0)
        self._ended = False
        self._steps_left = self.n_steps

    def step(self) -> None:
        """Add one coefficient to the current frame; Raises as in `Solver`."""
        self._count_step()
        if self._ended:
            return
        correlation = self._correlations()
        best = int(np.argmax(np.abs(correlation)))
        rms = math.sqrt(float(np.mean(self._residual**2)))
        self._ended = abs(correlation[best]) <= self._stands_out * rms or best in self._support
        if self._ended:
            return
        atoms = np.vstack([self._atoms, self._atom(best)])
        try:
            found = np.linalg.solve(atoms @ atoms.T, atoms @ self._y)
        except np.linalg.LinAlgError:  # the atom is a sum of those before
            self._ended = True
            return
        self._atoms, self._found = atoms, found
        self._support.append(best)
        self._residual = self._y - found @ atoms

    def finish(self) -> Floats:
        self._steps_left = 0
        self._theta.fill(0)
        self._theta.reshape(-1)[self._support] = self._found
        forces = np.maximum(self.basis.synthesis(self._theta), 0)
        forces[~self.mask] = 0
        if not np.isfinite(forces).all():
            raise SolverError("omp: the forces are too large for float32")
        return forces

    def reset(self) -> None:
        """Do nothing: no state is carried from frame to frame."""

    def _correlations(self) -> Floats:
        """Return A^T r, float32 (n_rows * n_cols,)."""
        image = np.zeros(self.mask.shape, dtype=np.float32)
        image.reshape(-1)[self.taxels] = self.phi.adjoint(self._residual.astype(np.float32))
        return self.basis.analysis(image).reshape(-1)

    def _atom(self, index: int) -> Doubles:
        """Return a column of A, float64 (m,)."""
        theta = np.zeros(self.mask.shape, dtype=np.float32)
        theta.reshape(-1)[index] = 1
        image = self.basis.synthesis(theta).reshape(-1)
        return self.phi.forward(image[self.taxels]).astype(np.float64)
