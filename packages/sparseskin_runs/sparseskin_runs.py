"""A measurement matrix and a solver of another package, found by their entry points.

`RunSums` is phi "runs": each measurement is the sum of a run of neighbouring taxels. `Spread` is
solver "spread": it spreads each sum evenly over its run.
"""

import numpy as np

from sparseskin.nodes.compressor.phi.base import BLOCK, Phi, fingerprint_of
from sparseskin.nodes.reconstructor.solvers.base import Solver


class RunSums(Phi):
    """m rows of length 1, each over a run of successive taxels; the seed is not used.

    The first n mod m runs are one taxel longer than the others.
    """

    kind = "runs"

    def __init__(self, n: int, m: int, seed: int, block: int = BLOCK) -> None:
        super().__init__(n, m, seed, block)
        sizes = np.full(m, n // m)
        sizes[: n % m] += 1
        self.starts = np.cumsum(sizes) - sizes
        self._run_of_taxel = np.repeat(np.arange(m), sizes)
        # Rows of length 1: solvers rely on a largest eigenvalue of 1.
        self._scale = (1 / np.sqrt(sizes)).astype(np.float32)
        # A hash of what states the matrix: another program compares it before it inverts anything.
        self.fingerprint = fingerprint_of(self.kind, n, m, 1, self.starts)

    def _forward(self, x, out):
        sums = np.add.reduceat(x, self.starts)
        np.multiply(sums, self._scale, out)

    def _adjoint(self, y, out):
        np.take(y * self._scale, self._run_of_taxel, out=out)


class Spread(Solver):
    """x = max(0, Phi^T y): the least squares solution of least length, for rows of length 1 that
    share no taxel.
    """

    name = "spread"
    uses_basis = False

    def __init__(self, phi, basis, mask=None) -> None:
        super().__init__(phi, basis, mask)
        self.reset()

    def reset(self) -> None:
        self.watch = None  # nothing is carried from frame to frame

    def setup(self, y, warm=None) -> None:
        self._y = self._checked_y(y)
        self._steps_left = self.n_steps

    def step(self) -> None:
        self._count_step()

    def finish(self):
        self._steps_left = 0
        spread = self.phi.adjoint(self._y)
        forces = np.zeros(self.mask.shape, np.float32)
        forces.reshape(-1)[self.taxels] = np.maximum(spread, 0)
        return forces
