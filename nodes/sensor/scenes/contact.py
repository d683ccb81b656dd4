"""The contact model, one rigid body on a bed of unilateral spring-dampers, and its integrator.

Contact model. The body has the free coordinates q (height z in m, tilts in rad) and their rates
v = q'. Cell i, a taxel or a piece of ground, has the gap to the sole of the body

    g_i = g_i0 + J_i q,        penetration  d_i = -g_i,    d_i' = -J_i v,

and presses on the body with the force

    f_i(q, v) = max(0, k_i d_i + c_i d_i')  where d_i > 0,  and 0 elsewhere.

The cells are independent and never pull. With the diagonal inertia I and the constant load l
(-m g for z, 0 for a tilt about the centre of mass) the body moves by

    I v' = J^T f(q, v) + l.

Integrator. SDIRK2 with step dt, gamma = 1 - 1 / sqrt(2), h = gamma dt, in two implicit stages:

    stage 1:  I (v1 - v)  = h (J^T f(q  + h v1, v1) + l)
    between:  q* = q + (1 - gamma) dt v1,    v* = v + (1 - gamma) / gamma (v1 - v)
    stage 2:  I (v2 - v*) = h (J^T f(q* + h v2, v2) + l)
    result:   q(t + dt) = q* + h v2,         v(t + dt) = v2

It is of second order and L-stable on a linear bed: stable at any omega dt and c dt / m, and it
damps what is too fast for the step. Each stage is solved exactly by Newton's method on the set
of loaded cells (`RigidBody._solve_stage`). Where that set changes within a step, the step is
halved up to four times, and then done by implicit Euler, which on cells that only push never
adds energy and whose error is then one of a sixteenth of a step.

Limits. The rate d_i' is that of the free coordinates: the sliding of a sole along the skin moves
the gaps g_i0 between steps, and neither damps nor drags. There is no friction.

Sources: Habib et al., SkinSim (CASE 2014): spheres on springs and dampers. Alexander, Diagonally
implicit Runge-Kutta methods for stiff O.D.E.'s, SIAM J. Numer. Anal. 14 (1977).
"""

from __future__ import annotations

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
"""Most halvings of a time step in which cells come into contact or leave it.

A landing early or late by part of a step changes the height of the bounce. PSNR of the contact
frames against the exact solution (tests/nodes/sensor/scenes/test_exact.py): lift_wrench_40 59.0 dB,
11.7 dB below the noise, with 50 of 2325 frames above their noise and the worst (40.8 dB) at its
second landing; lift_box_40 73.4 dB, 26.8 dB below the noise."""


@dataclass(frozen=True, eq=False)
class Bed:
    """The cells under a body.

    Attributes
    ----------
    stiffness : ndarray of float64, shape (n_cells,)
        k of each cell, in N/m, above 0.
    damping : ndarray of float64, shape (n_cells,)
        c of each cell, in N s/m, 0 or more.
    gap : ndarray of float64, shape (n_cells,)
        g0: height of the sole above each unloaded cell at q = 0, in m.
    jacobian : ndarray of float64, shape (n_cells, n_dof)
        J: change of the gap with each free coordinate; 1 for z, in m/rad for a tilt.
    """

    stiffness: Doubles
    damping: Doubles
    gap: Doubles
    jacobian: Doubles

    def forces(self, q: Doubles, v: Doubles) -> Doubles:
        """Return the force of each cell on the body, in N, 0 or more; float64, shape (n_cells,).

        `q` and `v` are the coordinates of the body and their rates, in m and rad, m/s and rad/s;
        float64, shape (n_dof,).
        """
        gap = self.gap + self.jacobian @ q
        force = -(self.stiffness * gap + self.damping * (self.jacobian @ v))
        force[gap >= 0.0] = 0.0
        return np.maximum(force, 0.0, out=force)


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Inertia and load of a rigid body along its free coordinates.

    Attributes
    ----------
    inertia : ndarray of float64, shape (n_dof,)
        Mass in kg for z, moment of inertia in kg m2 for a tilt; above 0.
    load : ndarray of float64, shape (n_dof,)
        Constant generalised force: -m g in N for z, its moment in N m for a tilt.
    """

    inertia: Doubles
    load: Doubles

    def step(
        self, bed: Bed, q: Doubles, v: Doubles, dt_s: float, splits: int = _MAX_SPLITS
    ) -> tuple[Doubles, Doubles]:
        """Return q and v of the body after one time step, as described in this module.

        `bed` are the cells under the body, and `q` and `v` its coordinates and rates (`Bed.forces`)
        at the start of the step of `dt_s` seconds, which may be halved `splits` times; none is
        modified.
        """
        loaded0 = bed.forces(q, v).nonzero()[0]
        h = _GAMMA * dt_s
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
        if splits == 0:
            v_end, _ = self._solve_stage(bed, q, v, dt_s)  # implicit Euler
            return q + dt_s * v_end, v_end
        q, v = self.step(bed, q, v, dt_s / 2, splits - 1)
        return self.step(bed, q, v, dt_s / 2, splits - 1)

    def _solve_stage(self, bed: Bed, q: Doubles, v: Doubles, h: float) -> tuple[Doubles, Indices]:
        """Return the w of I (w - v) = h (J^T f(q + h w, w) + l), and the indices of loaded cells.

        The cells that may press are found first, from the free motion of the body. On them f is
        continuous, piecewise linear and monotone in w, and the equation is the gradient of a
        convex function: Newton's method on the set of loaded cells, with step halving, converges.
        """
        free = v + h / self.inertia * self.load
        gap = bed.gap + bed.jacobian @ q
        lowest = np.minimum(gap, gap + bed.jacobian @ (h * free))
        near = (lowest < 0.0).nonzero()[0]
        if near.size == 0:
            return free, near
        jacobian = bed.jacobian.take(near, axis=0)
        spring = bed.stiffness.take(near) * gap.take(near)
        slope = bed.stiffness.take(near) * h + bed.damping.take(near)

        def cost_of(w: Doubles) -> float:
            """The convex function whose gradient is the residual of the stage equation."""
            push = np.maximum(-(spring + slope * (jacobian @ w)), 0.0)
            off = w - free
            return float(0.5 * (self.inertia * off) @ off + 0.5 * h * (push / slope) @ push)

        w = v
        loaded = spring + slope * (jacobian @ w) < 0.0
        for _ in range(_MAX_NEWTON):
            h_loaded = h * loaded
            matrix = jacobian.T @ (jacobian * (h_loaded * slope)[:, None])
            matrix.flat[:: len(w) + 1] += self.inertia
            right = self.inertia * free - (h_loaded * spring) @ jacobian
            target: Doubles = np.asarray(
                right / matrix[0] if len(w) == 1 else np.linalg.solve(matrix, right),
                dtype=np.float64,
            )
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
