"""Orthogonal matching pursuit: one coefficient after the other, down to the noise level."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Floats, Mask
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
        k, shape = self.n_steps, self.mask.shape
        # QR decomposition of the atoms so far.
        self._q = np.zeros((k, phi.m), dtype=np.float64)
        self._triangle = np.zeros((k, k), dtype=np.float64)
        self._projected = np.zeros(k, dtype=np.float64)
        self._r = np.zeros(phi.m, dtype=np.float64)
        self._x = np.zeros(phi.n, dtype=np.float32)
        self._image: Floats = np.zeros(shape, dtype=np.float32)
        self._theta: Floats = np.zeros(shape, dtype=np.float32)
        self._support: list[int] = []
        self._ended = False
        noise = 2 * math.log(max(basis.n_rows * basis.n_cols, 2)) * phi.m / phi.n
        self._stands_out = math.sqrt(noise)

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        """Begin a frame; parameters and Raises as in `solve`. A warm start is not used."""
        y = self._checked_y(y)
        if warm is not None:
            self._checked_warm(warm)
        self._r[:] = y
        self._support.clear()
        self._ended = False
        self._steps_left = self.n_steps

    def step(self) -> None:
        """Add one coefficient to the current frame; Raises as in `Solver`."""
        self._count_step()
        if self._ended:
            return
        correlation = self._correlations()
        best = int(np.argmax(np.abs(correlation)))
        rms = math.sqrt(float(np.mean(self._r**2)))
        if abs(correlation[best]) <= self._stands_out * rms or best in self._support:
            self._ended = True
            return
        k = len(self._support)
        atom = self._atom(best)
        inside = self._q[:k] @ atom
        atom -= inside @ self._q[:k]
        again = self._q[:k] @ atom  # once is not accurate for nearly parallel atoms
        atom -= again @ self._q[:k]
        length = float(np.linalg.norm(atom))
        if not length > 1e-6:
            self._ended = True
            return
        self._q[k] = atom / length
        self._triangle[:k, k] = inside + again
        self._triangle[k, k] = length
        self._projected[k] = self._q[k] @ self._r
        self._r -= self._projected[k] * self._q[k]
        self._support.append(best)

    def finish(self) -> Floats:
        self._steps_left = 0
        k = len(self._support)
        self._theta.fill(0)
        if k:
            found = np.linalg.solve(self._triangle[:k, :k], self._projected[:k])
            self._theta.reshape(-1)[self._support] = found
        forces = np.maximum(self.basis.synthesis(self._theta), 0)
        forces[~self.mask] = 0
        if not np.isfinite(forces).all():
            raise SolverError("omp: the forces are too large for float32")
        return forces

    def reset(self) -> None:
        """Do nothing: no state is carried from frame to frame."""

    def _correlations(self) -> Floats:
        """Return A^T r, float32 (n_rows * n_cols,)."""
        self.phi.adjoint(self._r.astype(np.float32), self._x)
        flat = self._image.reshape(-1)
        flat.fill(0)
        flat[self.taxels] = self._x
        return self.basis.analysis(self._image).reshape(-1)

    def _atom(self, index: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """Return a column of A, float64 (m,)."""
        self._theta.fill(0)
        self._theta.reshape(-1)[index] = 1
        image = self.basis.synthesis(self._theta).reshape(-1)
        return self.phi.forward(image[self.taxels]).astype(np.float64)
