"""Solvers under rotating rows: each frame is restored from the measurements of its own phase."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.solver import Mask, Solver, make_solver


class RotatingSolver(Solver):
    """A solver of any kind for each phase; what one found, the next begins with.

    Parameters
    ----------
    solvers : dict of str to Solver
        By the fingerprint of its phi.
    phi, basis, mask
        As in `Solver`; phi is the first of the phases.
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
        """Take measurements of this phase from the next frame on; Raises as in `Solver`."""
        if phi.fingerprint not in self._solvers:
            raise SolverError(f"solver: was not made for phi {phi.fingerprint}")
        self.phi, self._chosen = phi, self._solvers[phi.fingerprint]

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        """Begin a frame; parameters and Raises as in `solve`."""
        self._chosen.setup(y, self._last if warm is None else warm)
        self.n_steps = self._chosen.n_steps

    def step(self) -> None:
        """Do one iteration of the frame that was begun."""
        self._chosen.step()

    def finish(self) -> Floats:
        """End the frame and return its estimate, as `solve` does."""
        self._last = None
        forces = self._chosen.finish()
        self._last = forces.copy()
        return forces

    def reset(self) -> None:
        """Forget all earlier frames."""
        self._last = None
        for solver in self._solvers.values():
            solver.reset()


def make_rotating_solver(
    name: str, phases: Sequence[Phi], basis: Basis, mask: Mask | None = None, **settings: Any
) -> Solver:
    """Make a solver by name for the measurements of several phases.

    Parameters
    ----------
    name, basis, mask, **settings
        As in `make_solver`.
    phases : sequence of Phi
        As `phases_of` gives them, the first at least.

    Returns
    -------
    Solver
        Its `use` chooses the phase of the next frame; the first one is chosen.

    Raises
    ------
    SolverError
        As in `make_solver`.
    """
    solver = make_solver(name, phases[0], basis, mask, **settings)
    if len(phases) == 1 or getattr(solver, "rotates", False):
        return solver
    solvers = {phases[0].fingerprint: solver}
    for phi in phases[1:]:
        solvers[phi.fingerprint] = make_solver(name, phi, basis, mask, **settings)
    return RotatingSolver(solvers, phases[0], basis, mask)
