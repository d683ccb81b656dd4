"""The time of a frame: how many steps of a solver fit into it on this host."""

import math
import time
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.skin.vectors import CONVERGED, N_FORMULA
from sparseskin.nodes.reconstructor.solvers.base import CountsTiles, Solver, solver_fact

LEAST_STEPS = 3
"""Steps that are done in any case by a solver without paces. Chosen."""
SHARE = 0.5
"""Part of the time between frames that a frame may take. Derived: as much is left for the other
nodes of the patch, and for a first frame after a pause."""
N_FIRST = 2
N_TIMED = 6
ENOUGH_S = 0.2
"""Frames that are not timed, for memory and caches; largest number of frames that are; and the time
after which no other is, seconds."""
N_OF_TILES = 16
"""The same number where three kinds of frames are compared: least times of few differ by more than
what a step takes. Chosen."""
LEAST_S = 1e-6
"""Least time that the tiles of a frame take: a clock that shows none states no time. Chosen."""


class Costs(NamedTuple):
    """Time of a frame of a solver on this host: of all but its steps, and of each step; seconds."""

    frame_s: float
    step_s: float

    def of(self, steps: int) -> float:
        """Time of a frame of this many steps, seconds."""
        return self.frame_s + steps * self.step_s

    def steps_in(self, budget_s: float, most: int) -> int:
        """Number of steps that fit into a budget, at most `most`, at least `LEAST_STEPS`."""
        # A coarse clock may show no time for a step.
        if self.step_s <= 0:
            return most
        n_fitting = int((budget_s - self.frame_s) / self.step_s)
        return min(max(n_fitting, LEAST_STEPS), most)


class TileCosts(NamedTuple):
    """Time of a frame of a solver that counts tiles: of all but its steps, of each step without any
    tile, and of each tile in a step; seconds.
    """

    frame_s: float
    step_s: float
    tile_s: float

    def times(self, budget_s: float) -> tuple[int, int]:
        """Times of the steps of a frame and of a step, in that of a tile, as of `use_times`."""
        left_s = max(budget_s - self.frame_s, self.tile_s)
        # Rounded so that the times of steps are never too short.
        frame_tiles = int(left_s / self.tile_s)
        step_tiles = math.ceil(self.step_s / self.tile_s)
        return frame_tiles, step_tiles

    def of(self, n_steps: int, n_tiles: int) -> float:
        """Time of a frame of so many steps and, in all of them, tiles; seconds."""
        return self.frame_s + n_steps * self.step_s + n_tiles * self.tile_s


def steps_within(
    solver: Solver, phi: Phi, f_max: float, budget_s: float
) -> tuple[int, float]:
    """Number of steps of a frame that fit into a budget on this host, and its time, seconds; where
    every taxel is pressed.

    A solver that has paces uses the largest one that fits: of few, hosts that differ a little
    choose the same one. A solver that counts tiles does more where few are pressed.
    """
    if isinstance(solver, CountsTiles):
        return _steps_of_tiles(solver, phi, f_max, budget_s)
    costs = measured_costs(solver, phi, f_max)
    paces = solver_fact(solver, "paces")
    if not paces:
        n_steps = costs.steps_in(budget_s, solver.n_steps)
        return n_steps, costs.of(n_steps)
    # What a step takes may depend on their number: each pace is timed anew.
    fewer = [pace for pace in paces if pace < solver.n_steps]
    while fewer and costs.of(solver.n_steps) > budget_s:
        solver.use_pace(fewer.pop())
        costs = measured_costs(solver, phi, f_max, 1)
    return solver.n_steps, costs.of(solver.n_steps)


def _steps_of_tiles(
    solver: CountsTiles, phi: Phi, f_max: float, budget_s: float
) -> tuple[int, float]:
    """As `steps_within`, of a solver that counts tiles."""
    # 0: while it is timed, a frame has all its steps.
    solver.use_times(0, 0)
    costs = tile_costs(solver, phi, f_max)
    n_steps = solver.n_steps
    frame_s = costs.of(n_steps, n_steps * solver.most_tiles)
    if frame_s <= budget_s:
        return n_steps, frame_s
    solver.use_times(*costs.times(budget_s))
    n_formula, n = solver.steps_for(solver.most_tiles)
    return n, costs.of(n_formula + n, n * solver.most_tiles)


def tile_costs(solver: CountsTiles, phi: Phi, f_max: float) -> TileCosts:
    """Time frames in which every taxel is pressed by up to f_max, newtons, and none; the solver is
    reset, and does its largest number of steps in each frame.
    """
    rng = np.random.default_rng(0)
    n_steps = solver.n_steps
    n_fewer = max(n_steps // 3, 1)
    forces = rng.uniform(0, f_max, (N_OF_TILES, phi.n))
    pressed = phi.forward(forces.astype(np.float32))
    untouched = np.zeros(phi.m, dtype=np.float32)

    # In turn: what else runs on the host slows down all of them.
    fewer_s = math.inf
    untouched_s = math.inf
    pressed_s = math.inf
    n_tiles = 0
    begin_s = time.perf_counter()
    for k, y in enumerate(pressed):
        fewer_s = min(fewer_s, _time_of(solver, phi, untouched, n_fewer))
        untouched_s = min(untouched_s, _time_of(solver, phi, untouched, n_steps))
        frame_s = _time_of(solver, phi, y, n_steps)
        if frame_s < pressed_s:
            pressed_s = frame_s
            n_tiles = solver.n_tiles
        if k >= N_FIRST and time.perf_counter() > begin_s + ENOUGH_S:
            break
    solver.reset()

    # Frames of fewer steps have some others, by a formula, before them.
    n_between = n_steps - n_fewer
    if n_fewer < CONVERGED <= n_steps:
        n_between -= N_FORMULA
    step_s = max(untouched_s - fewer_s, 0.0) / max(n_between, 1)
    tile_s = max(pressed_s - untouched_s, LEAST_S) / max(n_tiles, 1)
    frame_s = max(untouched_s - n_steps * step_s, 0.0)
    return TileCosts(frame_s, step_s, tile_s)


def _time_of(solver: CountsTiles, phi: Phi, y: Floats, n_steps: int) -> float:
    """Time of a first frame of measurements y of so many steps, seconds."""
    solver.use_pace(n_steps)
    solver.reset()
    if solver.subsets:
        solver.use(phi)
    begin_s = time.perf_counter()
    solver.solve(y)
    return time.perf_counter() - begin_s


def measured_costs(
    solver: Solver, phi: Phi, f_max: float, n_first: int = N_FIRST
) -> Costs:
    """Time frames in which every taxel is pressed by up to f_max, newtons; the solver is reset.

    Of each time the least of all frames counts: what else runs on the host only adds to it.
    """
    rng = np.random.default_rng(0)
    least_frame_s = math.inf
    least_step_s = math.inf
    begin_s = time.perf_counter()
    for k in range(n_first + N_TIMED):
        forces = rng.uniform(0, f_max, phi.n)
        y = phi.forward(forces.astype(np.float32))
        if getattr(solver, "subsets", ()):
            solver.use(phi)

        setup_s = time.perf_counter()
        solver.setup(y)
        steps_s = time.perf_counter()
        for _ in range(solver.n_steps):
            solver.step()
        finish_s = time.perf_counter()
        solver.finish()
        end_s = time.perf_counter()
        # The first ones fill memory and caches.
        if k < n_first:
            continue

        frame_s = steps_s - setup_s + end_s - finish_s
        least_frame_s = min(least_frame_s, frame_s)
        step_s = (finish_s - steps_s) / max(solver.n_steps, 1)
        least_step_s = min(least_step_s, step_s)
        if end_s > begin_s + ENOUGH_S:
            break
    solver.reset()
    return Costs(least_frame_s, least_step_s)
