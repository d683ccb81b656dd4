"""The solver "skin" with one ingredient left out at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.bases.shifted_haar import SHIFTS
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver

#: The parts of a solver are its own; a study that takes them out has to reach into it.
Change = Callable[[Any], None]


def _with(name: str, value: Any) -> Change:
    """The change of one attribute, or of an attribute of a part: "part.attribute"."""
    part, _, attribute = name.rpartition(".")

    def change(solver: Any) -> None:
        setattr(getattr(solver, part) if part else solver, attribute, value)

    return change


def _no_memory(solver: Any) -> None:
    """Every frame from nothing, as many iterations as a jump has."""
    setup = solver.setup

    def forgetful(y: Floats, warm: Floats | None = None) -> None:
        bias, next_shift = solver._bias.b, solver._next_shift
        n_frames = solver._bias._n_frames
        solver.reset()
        solver._bias.b, solver._next_shift, solver._bias._n_frames = bias, next_shift, n_frames
        setup(y, warm)

    solver.setup = forgetful


def _no_gain(solver: Any) -> None:
    update = solver._gain.update

    def full_gain(innovation: Floats, correction: Floats, m: int, s2: float, jumped: bool) -> None:
        update(innovation, correction, m, s2, jumped)
        solver._gain.gain = 1.0

    solver._gain.update = full_gain


def _no_doubt(solver: Any) -> None:
    update = solver._gain.update

    def believing(innovation: Floats, correction: Floats, m: int, s2: float, jumped: bool) -> None:
        update(innovation, np.zeros_like(correction), m, s2, jumped)

    solver._gain.update = believing


def _one_shift(solver: Any) -> None:
    solver._shifts = [SHIFTS.index((0, 0))] * len(solver._shifts)


def _negative_too(solver: Any) -> None:
    """Negative forces are cut off at the end of a frame alone."""
    solver._zeros.fill(-np.inf)
    finish = solver.finish

    def cut() -> Floats:
        np.maximum(solver._sum, 0, out=solver._sum)
        forces: Floats = finish()
        return forces

    solver.finish = cut


def _soft(solver: Any) -> None:
    """c - clip(c, -lambda, lambda) in place of the garrote."""
    haar, x, lambda2 = solver._haar, solver._canvas, solver._lambda2
    c, scratch = np.zeros_like(x), np.zeros_like(x)
    width = np.sqrt(haar.weights2)

    def shrink() -> None:
        limit = np.sqrt(lambda2) / width
        np.subtract(c, np.clip(c, -limit, limit), c)
        np.multiply(c, haar.weights2, c)

    analysis, synthesis = haar.analysis(x, c, scratch), haar.synthesis(c, x, scratch)
    solver._shrink = [*analysis, (shrink, ()), *synthesis]


def _no_momentum(solver: Any) -> None:
    solver._momentum[()] = 0


def _same_iterations(solver: Any) -> None:
    solver.max_iterations = solver.iterations


WITHOUT: dict[str, Change | None] = {
    "all of it": None,
    "bias of clipped noise": _with("_bias.update", lambda left, x, s2: None),
    "shifts": _one_shift,
    "garrote (soft threshold instead)": _soft,
    "x >= 0 in the iteration": _negative_too,
    "momentum": _no_momentum,
    "motion of the prediction": _with("_prediction._move", lambda x, y, innovation, e2, s2: e2),
    "weight of the prediction (K = 1)": _no_gain,
    "doubt of a lagging filter": _no_doubt,
    "more iterations where surprised": _same_iterations,
    "rows of earlier phases": _with("_memory", None),
    "last frame": _no_memory,
}


def changed_solver(name: str, phi: Phi, shape: tuple[int, int]) -> SkinSolver:
    """Make the solver "skin" without one ingredient of `WITHOUT`."""
    # Compiled loops would still do what a change takes out.
    solver = SkinSolver(phi, make_basis("haar", *shape), fast="off")
    change = WITHOUT[name]
    if change is not None:
        change(solver)
    return solver
