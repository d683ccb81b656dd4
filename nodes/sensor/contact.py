"""One rigid body on a bed of unilateral spring-dampers, and the integrator that moves it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

GRAVITY_M_S2 = 9.81

# The diagonal coefficient of the two-stage SDIRK method that is both second order and L-stable.
_GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
# Newton ends when the set of loaded cells repeats, as a rule after two or three rounds.
_MAX_NEWTON = 50
_MAX_HALVINGS = 30
# A step in which cells come into contact or leave it is halved up to so many times. A landing
# hurried or delayed by a part of a step is a bounce of another height: with undivided steps of
# 1 ms the frames of the wrench are off by more than the noise, with sixteenths 16 dB below it.
_MAX_SPLITS = 4


@dataclass(frozen=True, eq=False)
class Bed:
    """Independent cells, each pressing back on the body by a spring and a damper.

    A cell pushes with f = max(0, k d + c d') where the penetration d is positive, and not at all
    elsewhere: it never pulls.

    Attributes
    ----------
    stiffness : ndarray of float64, shape (n_cells,)
        k of each cell, in N/m, above 0.
    damping : ndarray of float64, shape (n_cells,)
        c of each cell, in N s/m, 0 or more.
    gap : ndarray of float64, shape (n_cells,)
        Height of the sole above each unloaded cell with all coordinates of the body at 0, in m.
    jacobian : ndarray of float64, shape (n_cells, n_dof)
        Change of the gap with each free coordinate: 1 for z, in m/rad for a tilt.

    Notes
    -----
    Source: Habib et al., SkinSim (CASE 2014): a layer of spheres on springs and dampers.
    """

    stiffness: Array
    damping: Array
    gap: Array
    jacobian: Array

    def forces(self, q: Array, v: Array) -> Array:
        """Force of each cell on the body.

        Parameters
        ----------
        q, v : ndarray of float64, shape (n_dof,)
            Coordinates of the body and their rates, in m and rad, m/s and rad/s.

        Returns
        -------
        ndarray of float64, shape (n_cells,)
            Forces in N, 0 or more; 0 where the body does not touch.
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

    inertia: Array
    load: Array

    def step(self, bed: Bed, q: Array, v: Array, dt_s: float) -> tuple[Array, Array]:
        """Advance the body by one time step.

        SDIRK2: implicit, second order, L-stable; it damps what is too fast for the step, where an
        explicit method blows up. That holds on a linear bed. Where the loaded cells change within
        the step, its extrapolating second stage could throw the body off a bed that cannot pull
        it back. Such a step is halved, and its halves again, up to four times; where they still
        change, it is done by implicit Euler, which on springs and dampers that only push never
        adds energy, and whose error of second order is then one of a sixteenth of a step. So the
        whole is second order, and stable at any omega dt and c dt / m.

        Parameters
        ----------
        bed : Bed
            The cells under the body at the time of the step.
        q, v : ndarray of float64, shape (n_dof,)
            Coordinates (m, rad) and rates (m/s, rad/s) at the start; not modified.
        dt_s : float
            Time step in s, above 0.

        Returns
        -------
        q, v : ndarray of float64, shape (n_dof,)
            Coordinates and rates at the end of the step.

        Notes
        -----
        Source: Alexander, Diagonally implicit Runge-Kutta methods for stiff O.D.E.'s,
        SIAM J. Numer. Anal. 14 (1977).
        """
        return self._advance(bed, q, v, dt_s, _MAX_SPLITS)

    def _advance(
        self, bed: Bed, q: Array, v: Array, dt_s: float, splits: int
    ) -> tuple[Array, Array]:
        loaded0 = bed.forces(q, v).nonzero()[0]
        h = _GAMMA * dt_s
        v1, loaded1 = self._solve_stage(bed, q, v, h)
        if np.array_equal(loaded0, loaded1):
            # The second stage starts from what the first one leaves: slopes v1 and (v1 - v) / h.
            carry = (1.0 - _GAMMA) * dt_s
            v_start = v + carry / h * (v1 - v)
            q_start = q + carry * v1
            v2, loaded2 = self._solve_stage(bed, q_start, v_start, h)
            if np.array_equal(loaded1, loaded2):
                return q_start + h * v2, v2
        if splits == 0:
            return self._euler(bed, q, v, dt_s)
        q, v = self._advance(bed, q, v, dt_s / 2, splits - 1)
        return self._advance(bed, q, v, dt_s / 2, splits - 1)

    def _euler(self, bed: Bed, q: Array, v: Array, dt_s: float) -> tuple[Array, Array]:
        v_end, _ = self._solve_stage(bed, q, v, dt_s)
        return q + dt_s * v_end, v_end

    def _solve_stage(self, bed: Bed, q: Array, v: Array, h: float) -> tuple[Array, Indices]:
        """Rates w after an implicit Euler step of length h: I (w - v) = h (J^T f(q + h w, w) + l).

        Which cells may press is settled first, by where free motion would take the body. Then f
        is continuous, piecewise linear and monotone in w, and the equation is the gradient of a
        convex function, so that Newton on the set of loaded cells, with step halving, converges.
        Returns w and the indices of the loaded cells.
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

        w = v
        loaded = spring + slope * (jacobian @ w) < 0.0
        for _ in range(_MAX_NEWTON):
            h_loaded = h * loaded
            matrix = jacobian.T @ (jacobian * (h_loaded * slope)[:, None])
            matrix.flat[:: len(w) + 1] += self.inertia
            right = self.inertia * free - (h_loaded * spring) @ jacobian
            target: Array = np.asarray(
                right / matrix[0] if len(w) == 1 else np.linalg.solve(matrix, right),
                dtype=np.float64,
            )
            reached = spring + slope * (jacobian @ target) < 0.0
            # With the same cells loaded, the full step has solved the equation exactly.
            if bool((reached == loaded).all()):
                return target, near[loaded]
            cost = self._cost(w, free, jacobian, spring, slope, h)
            trial = target
            for _ in range(_MAX_HALVINGS):
                if self._cost(trial, free, jacobian, spring, slope, h) <= cost:
                    break
                trial = 0.5 * (w + trial)
            w = trial
            loaded = spring + slope * (jacobian @ w) < 0.0
        return w, near[loaded]

    def _cost(
        self, w: Array, free: Array, jacobian: Array, spring: Array, slope: Array, h: float
    ) -> float:
        """The convex function whose gradient is the residual of the stage equation."""
        push = np.maximum(-(spring + slope * (jacobian @ w)), 0.0)
        off = w - free
        return float(0.5 * (self.inertia * off) @ off + 0.5 * h * (push / slope) @ push)
