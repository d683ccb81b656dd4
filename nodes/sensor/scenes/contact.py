"""The contact model, one rigid body on a bed of unilateral spring-dampers, and its integrator.

Symbols, model, limits and sources: docs/explanation/scenes.md. With h = gamma dt a step is two
implicit stages, then implicit Euler where the set of loaded cells still changes in a sixteenth:

    stage 1:  I (v1 - v)  = h (J^T f(q  + h v1, v1) + l)
    between:  q* = q + (1 - gamma) dt v1,    v* = v + (1 - gamma) / gamma (v1 - v)
    stage 2:  I (v2 - v*) = h (J^T f(q* + h v2, v2) + l)
    result:   q(t + dt) = q* + h v2,         v(t + dt) = v2
"""

import math
from dataclasses import dataclass

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles, Indices

GRAVITY_M_S2 = 9.81
"""Acceleration of gravity in m/s2."""
_GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
"""Diagonal coefficient of the two-stage SDIRK method that is of second order and L-stable."""
_MAX_NEWTON = 50
"""Most Newton iterations of a stage; it ends when the set of loaded cells repeats, as a rule after
two or three."""
_MAX_HALVINGS = 30
"""Most halvings of a Newton step that does not lower the cost."""
_MAX_SPLITS = 4
"""Most halvings of a time step in which cells come into contact or leave it. A landing early or
late by part of a step changes the height of the bounce: test_exact.py has the errors.
"""


@dataclass(frozen=True, eq=False)
class Bed:
    """The cells under a body: arrays of float64, shape (n_cells,), and (n_cells, n_dof)."""

    stiffness: Doubles  # k in N/m, above 0
    damping: Doubles  # c in N s/m, 0 or more
    gap: Doubles  # g0, height of the sole above an unloaded cell at q = 0, in m
    jacobian: Doubles  # J, change of the gap: 1 for z, in m/rad for a tilt

    def forces(self, q: Doubles, v: Doubles) -> Doubles:
        """The force of each cell on the body, N, 0 or more; `q` and `v` are the coordinates of the
        body and their rates, m and rad, float64 (n_dof,).
        """
        gap = self.gap + self.jacobian @ q
        force = -(self.stiffness * gap + self.damping * (self.jacobian @ v))
        force[gap >= 0.0] = 0.0
        return np.maximum(force, 0.0, out=force)


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Inertia and load of a rigid body along its free coordinates: float64, shape (n_dof,)."""

    inertia: Doubles  # kg for z, kg m2 for a tilt; above 0
    load: Doubles  # constant: -m g in N for z, its moment in N m for a tilt

    def step(
        self, bed: Bed, q: Doubles, v: Doubles, dt_s: float, splits: int = _MAX_SPLITS
    ) -> tuple[Doubles, Doubles]:
        """q and v of the body after a time step (see the module) on the cells of `bed`, from those
        at its beginning (`Bed.forces`). It may be halved `splits` times.
        """
        h = _GAMMA * dt_s
        loaded0 = bed.forces(q, v).nonzero()[0]
        v1, loaded1 = self._solve_stage(bed, q, v, h)
        if np.array_equal(loaded0, loaded1):
            # Stage 2 extrapolates the slopes of stage 1, v1 and (v1 - v) / h. Where the loaded
            # cells change it could throw the body off a bed that cannot pull it back.
            carry = (1.0 - _GAMMA) * dt_s
            v_start = v + carry / h * (v1 - v)
            q_start = q + carry * v1
            v2, loaded2 = self._solve_stage(bed, q_start, v_start, h)
            if np.array_equal(loaded1, loaded2):
                return q_start + h * v2, v2

        # Implicit Euler stays stable, whatever the cells do.
        if splits == 0:
            v_end, _ = self._solve_stage(bed, q, v, dt_s)
            return q + dt_s * v_end, v_end
        q, v = self.step(bed, q, v, dt_s / 2, splits - 1)
        return self.step(bed, q, v, dt_s / 2, splits - 1)

    def _solve_stage(
        self, bed: Bed, q: Doubles, v: Doubles, h: float
    ) -> tuple[Doubles, Indices]:
        """Return the w of I (w - v) = h (J^T f(q + h w, w) + l), and the indices of loaded cells.

        The cells that may press are found first, from the free motion of the body. On them f is
        continuous, piecewise linear and monotone in w, and the equation is the gradient of a
        convex function: Newton's method on the set of loaded cells, with step halving, converges.
        """
        # Cells that even the free motion does not reach press on nothing.
        free = v + h / self.inertia * self.load
        gap = bed.gap + bed.jacobian @ q
        lowest = np.minimum(gap, gap + bed.jacobian @ (h * free))
        near = (lowest < 0.0).nonzero()[0]
        if near.size == 0:
            return free, near

        # The push of a cell is max(0, -(spring + slope J w)).
        jacobian = bed.jacobian.take(near, axis=0)
        stiffness = bed.stiffness.take(near)
        spring = stiffness * gap.take(near)
        slope = stiffness * h + bed.damping.take(near)

        def cost_of(w: Doubles) -> float:
            """The convex function whose gradient is the residual of the stage equation."""
            push = np.maximum(-(spring + slope * (jacobian @ w)), 0.0)
            off = w - free
            kinetic = 0.5 * (self.inertia * off) @ off
            elastic = 0.5 * h * (push / slope) @ push
            return float(kinetic + elastic)

        w = v
        loaded = spring + slope * (jacobian @ w) < 0.0
        for _ in range(_MAX_NEWTON):
            h_loaded = h * loaded
            matrix = jacobian.T @ (jacobian * (h_loaded * slope)[:, None])
            matrix.flat[:: len(w) + 1] += self.inertia
            right = self.inertia * free - (h_loaded * spring) @ jacobian
            # For the one unknown of a fall, LAPACK takes over ten times as long as a division.
            if len(w) == 1:
                target: Doubles = right / matrix[0]
            else:
                target = np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)

            reached = spring + slope * (jacobian @ target) < 0.0
            # With the same cells loaded, the full step has solved the equation exactly.
            if bool((reached == loaded).all()):
                return target, near[loaded]

            cost = cost_of(w)
            trial = target
            for _ in range(_MAX_HALVINGS):
                if cost_of(trial) <= cost:
                    break
                trial = 0.5 * (w + trial)
            w = trial
            loaded = spring + slope * (jacobian @ w) < 0.0
        return w, near[loaded]
