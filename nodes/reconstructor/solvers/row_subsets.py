"""Solvers under rotating rows: each frame is reconstructed from its own row subset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import Basis

from .base import Solver, make_solver


class RotatingSolver(Solver):
    """One solver of any kind for each row subset; each starts from the estimate of the last frame.

    `solvers` are by the fingerprint of their phi; phi is the first row subset.
    """

    rotates = True

    def __init__(
        self, solvers: dict[str, Solver], phi: Phi, basis: Basis, mask: Mask | None = None
    ) -> None:
        super().__init__(phi, basis, mask)
        self._solvers = solvers
        self._chosen = solvers[phi.fingerprint]
        self._last: Floats | None = None
        self.n_steps = self._chosen.n_steps

    def use(self, phi: Phi) -> None:
        if phi.fingerprint not in self._solvers:
            raise SolverError(f"solver: was not made for phi {phi.fingerprint}")
        self.phi, self._chosen = phi, self._solvers[phi.fingerprint]

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        self._chosen.setup(y, self._last if warm is None else warm)
        self.n_steps = self._chosen.n_steps

    def step(self) -> None:
        self._chosen.step()

    def finish(self) -> Floats:
        self._last = None
        forces = self._chosen.finish()
        self._last = forces.copy()
        return forces

    def reset(self) -> None:
        self._last = None
        for solver in self._solvers.values():
            solver.reset()


def make_rotating_solver(
    name: str, subsets: Sequence[Phi], basis: Basis, mask: Mask | None = None, **settings: Any
) -> Solver:
    """Make a solver by name for one Phi of fixed rows, or the row subsets of rotating ones.

    Other parameters and Raises as in `make_solver`. `use` of the solver chooses the row subset of
    the next frame; the first one is chosen.
    """
    solver = make_solver(name, subsets[0], basis, mask, **settings)
    if len(subsets) == 1 or getattr(solver, "rotates", False):
        return solver
    solvers = {subsets[0].fingerprint: solver}
    for phi in subsets[1:]:
        solvers[phi.fingerprint] = make_solver(name, phi, basis, mask, **settings)
    return RotatingSolver(solvers, subsets[0], basis, mask)
