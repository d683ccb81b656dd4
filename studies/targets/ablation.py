"""The solver "skin" with one ingredient left out at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.bases.shifted_haar import SHIFTS
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.reconstructor.skin.tuning import TUNING, SkinTuning

#: Other constants, or a change of what none of them leaves out. The parts of a solver are its own:
#: such a change has to reach into it.
Change = SkinTuning | Callable[[Any], None]


def _without_rows(solver: Any) -> None:
    solver._memory = None


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


def _same_iterations(solver: Any) -> None:
    solver.max_iterations = solver.iterations


WITHOUT: dict[str, Change] = {
    "all of it": TUNING,
    "bias of clipped noise": replace(TUNING, bias_largest=0.0),
    "shifts": _one_shift,
    "garrote (soft threshold instead)": _soft,
    "x >= 0 in the iteration": _negative_too,
    "momentum": replace(TUNING, momentum=0.0),
    "motion of the prediction": replace(TUNING, motion_significant=math.inf),
    "weight of the prediction (K = 1)": replace(TUNING, gain_least=1.0),
    "doubt of a lagging filter": replace(TUNING, trust_least=1.0),
    "more iterations where surprised": _same_iterations,
    "rows of earlier phases": _without_rows,
    "last frame": _no_memory,
}


def changed_solver(name: str, phi: Phi, shape: tuple[int, int]) -> SkinSolver:
    """Make the solver "skin" without one ingredient of `WITHOUT`."""
    change = WITHOUT[name]
    tuning = change if isinstance(change, SkinTuning) else TUNING
    # Compiled loops would still do what a change takes out.
    solver = SkinSolver(phi, make_basis("haar", *shape), fast="off", tuning=tuning)
    if not isinstance(change, SkinTuning):
        change(solver)
    return solver
