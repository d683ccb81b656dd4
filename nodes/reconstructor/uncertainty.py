"""How far a restored force may be from the true one: a standard deviation for each taxel."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.reconstructor.solver import Mask

#: Part of the way to a frame's own change that the mean of squared changes goes.
RATE = 0.2
#: What the variance of an estimate is made of, by solver: the mean squared change, the noise, and
#: force times noise. Fitted on random scenes 20..31 at N/3 and N/4, so that bands of 1.645
#: deviations hold 90 %.
CALIBRATED = {"skin": (1.4, 0.0125, 0.027), "fista": (2.1, 4.7, 0.0)}


class Uncertainty:
    """Tells the standard deviation of restored forces from how they change from frame to frame.

    v = a d + b s^2 N / M + c s x, with a, b and c of the solver

    d is the running mean of the squared change of the taxel's estimate: one that the measurements
    do not hold wanders. s^2 is the mean square of what the frame leaves of the measurements, most
    of which is noise. A pressed taxel (x) is noisier than one that is not.

    An untouched taxel that is restored as 0 has a small deviation, never 0.

    Parameters
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists; elsewhere the deviation is 0.
    ratio : float
        N / M.
    solver : str
        One of `CALIBRATED`.
    """

    def __init__(self, mask: Mask, ratio: float, solver: str) -> None:
        self._change, self._noise, self._force = CALIBRATED[solver]
        self._noise *= ratio
        self._nowhere = None if mask.all() else ~mask
        vectors = np.zeros((4, *mask.shape), dtype=np.float32)
        self._last, self._changes, self._scaled, self._v = vectors

    def update(self, forces: Floats, residual: float) -> Floats:
        """Take in a restored frame.

        Parameters
        ----------
        forces : ndarray of float32, shape (n_rows, n_cols)
            Newtons.
        residual : float
            Root mean square of what it leaves of the measurements, newtons.

        Returns
        -------
        ndarray of float32, shape (n_rows, n_cols)
            Standard deviation of each force, newtons; the caller's own. Forces are not normal:
            90 % of the true ones lie within 1.645 of it, not 68 % within one.
        """
        v, changes = self._v, self._changes
        np.subtract(forces, self._last, out=v)
        np.copyto(self._last, forces)
        np.square(v, out=v)
        v -= changes
        v *= np.float32(RATE)
        changes += v
        np.multiply(forces, np.float32(self._force * residual), out=v)
        v += np.float32(self._noise * residual * residual)
        v += np.multiply(changes, np.float32(self._change), out=self._scaled)
        if self._nowhere is not None:
            v[self._nowhere] = 0
        sd: Floats = np.sqrt(v)
        return sd
