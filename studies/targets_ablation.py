"""The solver "skin" with one ingredient left out at a time: what each earns, and what it costs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.reconstructor.basis import make_basis
from sparseskin.nodes.reconstructor.shifted_haar import SHIFTS
from sparseskin.nodes.reconstructor.skin import SkinSolver

from .targets_points import Point, Tally, frames_of, phases_at

#: The parts of a solver are its own; a study that takes them out has to reach into it.
Change = Callable[[Any], None]


def _no_bias(solver: Any) -> None:
    solver._bias.update = lambda left, x, s2: None


def _no_motion(solver: Any) -> None:
    solver._prediction._move = lambda x, y, misfit, e2, s2: e2


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


def _no_weight(solver: Any) -> None:
    update = solver._filter.update

    def always_news(misfit: Floats, m: int, s2: float, jumped: bool) -> None:
        update(misfit, m, s2, jumped)
        solver._filter.weight = 1.0

    solver._filter.update = always_news


def _no_doubt(solver: Any) -> None:
    update = solver._filter.update

    def believing(misfit: Floats, m: int, s2: float, jumped: bool) -> None:
        solver._filter._past.energy = 0.0
        update(misfit, m, s2, jumped)

    solver._filter.update = believing


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


def _no_rows_of_before(solver: Any) -> None:
    solver._memory = None


def _no_caution(solver: Any) -> None:
    solver._watch_out = lambda unexplained, free: None


WITHOUT: dict[str, Change | None] = {
    "all of it": None,
    "bias of clipped noise": _no_bias,
    "shifts": _one_shift,
    "garrote (soft threshold instead)": _soft,
    "x >= 0 in the iteration": _negative_too,
    "momentum": _no_momentum,
    "motion of the prediction": _no_motion,
    "weight of the prediction (K = 1)": _no_weight,
    "doubt of a lagging filter": _no_doubt,
    "more iterations where surprised": _same_iterations,
    "caution where too much is explained": _no_caution,
    "rows of earlier phases": _no_rows_of_before,
    "last frame": _no_memory,
}


def ablated(point: Point) -> dict[str, Any]:
    """Restore a scene by "skin" without each ingredient in turn, on the same measurements.

    Parameters
    ----------
    point : dict
        scene, ratio, rows ("fixed" or "rotating"), n_frames, seed.

    Returns
    -------
    dict
        By ingredient the figures of `Tally`.
    """
    tallies = {name: Tally() for name in WITHOUT}
    solvers: dict[str, SkinSolver] = {}
    frames = frames_of(point["scene"], point["seed"], point["n_frames"])
    for k, (truth, taxels) in enumerate(frames):
        if not k:
            phases = phases_at(truth.size, point["ratio"], point["rows"], point["seed"])
            for name, change in WITHOUT.items():
                # What a change takes out, compiled loops would still do.
                solvers[name] = SkinSolver(phases[0], make_basis("haar", *truth.shape), fast="off")
                if change is not None:
                    change(solvers[name])
        phi = phases[k % len(phases)]
        y = phi.forward(taxels.reshape(-1))
        for name, solver in solvers.items():
            begin = time.perf_counter()
            solver.use(phi)
            estimate = solver.solve(y)
            tallies[name].add(estimate, truth, time.perf_counter() - begin)
    return {name: tally.figures() for name, tally in tallies.items()}
