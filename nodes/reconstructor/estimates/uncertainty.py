"""The standard deviation of each reconstructed force."""

import math
from typing import Any

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats, Mask, of_nine

SCALE = 1.1
"""Standard deviation of a touched taxel, in what its share of the squared error makes it. Fitted on
drawn worlds and presses, so that bands of 1.645 deviations hold 90 % of the touched taxels in the
median of them. With the true error of each frame it would be 0.95."""
EDGE_POWER = 0.25
"""Power of the mean force around a taxel that its deviation falls with, at the edge of a contact.
Chosen among 0.2, 0.25, 0.3 and 0.5 on the same streams and on the recordings of the tests."""
LEAST_AROUND = 0.1
"""Mean force around a taxel that nothing touches, in the error of the frame: contacts that are
missed have forces of that order. Chosen; 0.05 and 0.2 do as well."""
Calibrated = tuple[float, float]
"""Factor a and power b of the RMS error a (N / M)^b r that an RMS residual r shows. That of the
solvers is fitted on random presses at N/3, N/4 and N/8, of fixed and rotating rows."""
LEAST_ERROR = 1e-12
"""Least error of a taxel, in the unit of the forces: none is zero."""


class Uncertainty:
    """Standard deviation of reconstructed forces, by their error and where they press.

    sd = 1.1 e sqrt(N / n) min(1, (u + e / 10) / f)^(1/4)
    n = (sum x)^2 / sum x^2,  f = sum x^2 / sum x

    Nearly all of the squared error N e^2 lies on the touched taxels, about evenly. n is their
    effective number, by the forces x alone: without a threshold. At the edge of a contact the error
    falls, with the mean u of the forces on the 3 x 3 taxels around, in the mean force f.

    e is the RMS error of a taxel that the solver estimates in each frame, by measurements that are
    left out of their own values; of a solver that estimates none, a (N / M)^b r with the RMS
    residual r of the frame. Errors that no measurement shows are not in e: with fixed rows on small
    skins bands may hold less.

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
        self._spread = Spread(mask)

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
        return self._spread.deviations(forces, error)


class Spread:
    """The error of a frame on the taxels of a skin, as `Uncertainty` states it.

    Parameters
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.

    Notes
    -----
    Source of the effective number: the participation ratio of Bell, Dean, "Atomic vibrations in
    vitreous silica", Discussions of the Faraday Society 50, 1970, of the forces in place of their
    squares.
    """

    def __init__(self, mask: Mask) -> None:
        self._inside: Floats = mask.astype(np.float32)
        self._n = np.count_nonzero(mask)
        # A cell without a taxel is 0, and takes no part in a mean.
        sums = np.maximum(of_nine(self._inside, np.add), np.float32(1))
        weights: Any = self._inside / sums
        self._weights: Floats = weights

    def deviations(self, forces: Floats, error: float) -> Floats:
        """Standard deviations of forces of an RMS error, both float32 (n_rows, n_cols)."""
        e = max(error, LEAST_ERROR)
        x = np.abs(forces)
        total = float(x.sum(dtype=np.float64))
        if total == 0:
            return np.float32(SCALE * e) * self._inside

        # All of the squared error, on the effective number of touched taxels.
        squares = float(np.square(x, dtype=np.float64).sum())
        mean_force = max(squares / total, LEAST_ERROR)
        of_touched = e * math.sqrt(self._n * squares) / total

        # Beyond the edge of a contact the error falls with the forces around.
        around = of_nine(x, np.add) * self._weights
        around += np.float32(LEAST_AROUND * e)
        around /= np.float32(mean_force)
        part: Any = np.minimum(around, 1)
        part **= np.float32(EDGE_POWER)
        sd: Floats = np.float32(SCALE * of_touched) * part * self._inside
        return sd
