"""A solver of your own: projected gradient descent, which knows no sparsity.

python examples/own_solver.py

In a launch file: solver = "own_solver:ProjectedGradient" for the reconstructor; `shrinkage` is an
option of it, in the table [nodes.reconstructor.options].
"""

import numpy as np

import sparseskin
from sparseskin.nodes.reconstructor.solvers.base import Solver


class ProjectedGradient(Solver):
    """min ||Phi x - y||^2 / 2 + shrinkage sum x over x >= 0, from the last frame's forces."""

    def __init__(
        self, phi, basis, mask=None, *, iterations: int = 30, shrinkage: float = 0.0
    ) -> None:
        super().__init__(phi, basis, mask)
        self.n_steps = iterations
        self._shrinkage = shrinkage
        self.reset()

    def reset(self) -> None:
        self._x = np.zeros(self.phi.n, np.float32)

    def setup(self, y, warm=None) -> None:
        self._y = self._checked_y(y)
        if warm is not None:
            self._x = self._checked_warm(warm).reshape(-1)[self.taxels]

    def step(self) -> None:
        residual = self._y - self.phi.forward(self._x)
        descent = (self.phi.adjoint(residual) - self._shrinkage) / np.float32(
            self.phi.lipschitz
        )
        self._x = np.maximum(self._x + descent, 0)

    def finish(self):
        forces = np.zeros(self.mask.shape, np.float32)
        forces.reshape(-1)[self.taxels] = self._x
        return forces


def main() -> None:
    truth, taxels = sparseskin.simulate("lift_box_40", 340)
    phi = sparseskin.make_phi(
        "sbhe",
        n=1600,
        m=533,
        seed=0,
    )
    basis = sparseskin.make_basis("haar", 40, 40)
    measurements = sparseskin.compress(taxels, phi)
    for name in ("own_solver:ProjectedGradient", "fista"):
        solver = sparseskin.make_solver(name, phi, basis, iterations=30)
        sparseskin.check_solver(solver)
        reconstructed = sparseskin.reconstruct(measurements, solver)
        print(f"{name}: {sparseskin.psnr_db(reconstructed[-1], truth[-1]):.1f} dB")


if __name__ == "__main__":
    main()
