"""The time of a frame: how many steps of a solver fit into it on this host."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.reconstructor.solvers.base import Solver

LEAST_STEPS = 3
"""Steps that are done in any case by a solver without paces. Chosen."""
SHARE = 0.5
"""Part of the time between frames that a frame may take. Derived: as much is left for the other
nodes of the patch, and for a first frame after a pause."""
N_FIRST, N_TIMED, ENOUGH_S = 2, 6, 0.2
"""Frames that are not timed, for memory and caches; largest number of frames that are; and the time
after which no other is, seconds."""


class Costs(NamedTuple):
    """Time of a frame of a solver on this host: of all but its steps, and of each step; seconds."""

    frame_s: float
    step_s: float

    def of(self, steps: int) -> float:
        """Time of a frame of this many steps, seconds."""
        return self.frame_s + steps * self.step_s

    def steps_in(self, budget_s: float, most: int) -> int:
        """Number of steps that fit into a budget, at most `most`, at least `LEAST_STEPS`."""
        fit = int((budget_s - self.frame_s) / self.step_s) if self.step_s > 0 else most
        return min(max(fit, LEAST_STEPS), most)


def steps_within(solver: Solver, phi: Phi, f_max: float, budget_s: float) -> tuple[int, float]:
    """Number of steps of a frame that fit into a budget on this host, and its time, seconds.

    A solver that has paces uses the largest one that fits: of few, hosts that differ a little
    choose the same one.
    """
    paces = getattr(solver, "paces", ())
    costs = measured_costs(solver, phi, f_max)
    fewer = [pace for pace in paces if pace < solver.n_steps]
    while fewer and costs.of(solver.n_steps) > budget_s:
        solver.use_pace(fewer.pop())
        costs = measured_costs(solver, phi, f_max, 1)
    steps = solver.n_steps if paces else costs.steps_in(budget_s, solver.n_steps)
    return steps, costs.of(steps)


def measured_costs(solver: Solver, phi: Phi, f_max: float, n_first: int = N_FIRST) -> Costs:
    """Time frames in which every taxel is pressed by up to f_max, newtons; the solver is reset.

    Of each time the least of all frames counts: what else runs on the host only adds to it.
    """
    rng = np.random.default_rng(0)
    frames: list[float] = []
    steps: list[float] = []
    begin_s = time.perf_counter()
    for k in range(n_first + N_TIMED):
        y = phi.forward(rng.uniform(0, f_max, phi.n).astype(np.float32))
        if getattr(solver, "subsets", ()):
            solver.use(phi)
        times = [time.perf_counter()]
        solver.setup(y)
        times.append(time.perf_counter())
        for _ in range(solver.n_steps):
            solver.step()
        times.append(time.perf_counter())
        solver.finish()
        times.append(time.perf_counter())
        if k >= n_first:
            frames.append(times[1] - times[0] + times[3] - times[2])
            steps.append((times[2] - times[1]) / max(solver.n_steps, 1))
            if times[-1] > begin_s + ENOUGH_S:
                break
    solver.reset()
    return Costs(min(frames), min(steps))
