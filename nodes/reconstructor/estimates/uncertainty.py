"""The standard deviation of each reconstructed force."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats, Mask

SCALE = 1.5
"""Standard deviation of a typical force, in what its share of the squared error makes it. Fitted on
drawn worlds, presses and scenes, so that bands of 1.645 deviations hold 90 % of the touched taxels
in the median of them: a taxel that is touched has more than its share. The formula was chosen among
18 on these and on five recordings."""
Calibrated = tuple[float, float]
"""Factor a and power b of the RMS error a (N / M)^b r that an RMS residual r shows. That of the
solvers is fitted on random presses at N/3, N/4 and N/8, of fixed and rotating rows."""
LEAST_ERROR = 1e-12
"""Least error of a taxel, in the unit of the forces: none is zero."""


class Uncertainty:
    """Standard deviation of reconstructed forces, by their error and their changes in space.

    sd = 1.5 e sqrt(q / mean q),  q = sqrt(g^2 + e^2)

    e is the RMS error of a taxel that the solver estimates in each frame, by measurements that are
    left out of their own values; of a solver that estimates none, a (N / M)^b r with the RMS
    residual r of the frame. g is the sum of the absolute differences to the next taxels, averaged
    over 3 x 3: edges are uncertain, and what nothing touches is nearly always 0. Errors that no
    measurement shows are not in e: with fixed rows on small skins bands may hold less.

    Parameters
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists; elsewhere the deviation is 0.
    ratio : float
        N / M.
    calibrated : (float, float)
        a and b of the solver (`Solver.calibrated`).
    """

    def __init__(self, mask: Mask, ratio: float, calibrated: Calibrated) -> None:
        factor, power = calibrated
        self._factor = factor * ratio**power
        self._mask = mask

    def of(self, forces: Floats, residual: float, error: float | None) -> Floats:
        """Standard deviations of a frame.

        Parameters
        ----------
        forces : ndarray of float32, shape (n_rows, n_cols)
            Newtons; 0 where no taxel exists.
        residual : float
            RMS of its residual, newtons.
        error : float or None
            RMS error of a taxel as the solver estimates it, newtons.

        Returns
        -------
        ndarray of float32, shape (n_rows, n_cols)
            Standard deviation of each force, newtons; the caller's own. Forces are not normal:
            90 % of the true ones lie within 1.645 of it, not 68 % within one.
        """
        if error is None:
            error = self._factor * residual
        return deviations(forces, error, self._mask)


def deviations(forces: Floats, error: float, mask: Mask) -> Floats:
    """Standard deviations of forces of an RMS error, both float32 (n_rows, n_cols); see
    `Uncertainty`.
    """
    e = np.float32(max(error, LEAST_ERROR))
    q = np.hypot(_roughness(forces), e)
    q *= mask
    mean = q.sum(dtype=np.float64) / np.count_nonzero(mask)

    # Of the squared error, a taxel has a share in proportion to its q.
    share = np.sqrt(q / np.float32(mean))
    sd: Floats = np.float32(SCALE) * e * share
    return sd


def _roughness(forces: Floats) -> Floats:
    """Return the sum of both absolute differences to the next taxels, averaged over 3 x 3."""
    # A taxel at the last row or column has no next one: its difference is 0.
    down = np.diff(forces, axis=0, append=forces[-1:])
    right = np.diff(forces, axis=1, append=forces[:, -1:])
    differences = np.abs(down) + np.abs(right)

    # Beyond the edge the differences go on as they are at it.
    edged = np.pad(differences, 1, mode="edge")
    of_rows = edged[:-2] + edged[1:-1] + edged[2:]
    sums = of_rows[:, :-2] + of_rows[:, 1:-1] + of_rows[:, 2:]
    rough: Floats = sums / 9
    return rough
