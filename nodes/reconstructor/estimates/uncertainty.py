"""The standard deviation of each reconstructed force."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from sparseskin.nodes.compressor.phi.base import RANDOM, SUMS
from sparseskin.nodes.compressor.phi.rotation import FIXED
from sparseskin.nodes.numerics.arrays import Floats, Mask

#: Rates of the running mean of forces, and of squared changes: an estimate that lags behind a slow
#: slide changes little from frame to frame.
MEAN_RATE = np.float32(0.25)
RATE = np.float32(0.2)
#: Part of the RMS residual added to the change, squared, and to the force: taxels that stand still
#: or are untouched are not certain.
CHANGE_FLOOR = np.float32(0.03)
FORCE_FLOOR = np.float32(0.3)
Calibrated = Mapping[int, Mapping[str, tuple[float, float]]]
"""By rule of the rows of Phi, and "fixed" or "rotating": factor a, and power b of N / M. Those of
the solvers are fitted on random scenes at N/3, N/4 and N/8, so that bands of 1.645 deviations hold
90 % of the touched taxels, by the geometric mean over the scenes."""
LEAST_RESIDUAL = 1e-12
"""Least residual a taxel, in the unit of the forces: none is zero."""


class Uncertainty:
    """Standard deviation of reconstructed forces, from their changes in time and in space.

    sd = a (N / M)^b sqrt(r sqrt(p q)),  p = (d + 0.03 r^2) / (x + 0.3 r),  q = sqrt(g^2 + r^2)

    with a and b of the solver. r is the RMS residual of the frame, most of it noise. d is the
    running mean of the squared distance of the force x from its own running mean: an estimate that
    the measurements do not determine wanders, one that lags moves on; a change of all forces by
    the same factor is excluded, as it is followed well. g is the sum of the absolute differences to
    the next taxels, averaged over 3 x 3: edges are uncertain, and inside a flat contact the noise
    is averaged. The deviations scale with the range of the skin; that of an untouched taxel is
    small, never 0.

    Parameters
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists; elsewhere the deviation is 0.
    ratio : float
        N / M.
    calibrated : mapping
        That of the solver (`Solver.calibrated`).
    rows : str
        "fixed" or "rotating": with fixed rows, errors that none of them measures persist.
    rule : int
        Rule of the rows, as in `Phi`.
    """

    def __init__(
        self,
        mask: Mask,
        ratio: float,
        calibrated: Calibrated,
        rows: str = FIXED,
        rule: int = SUMS,
    ) -> None:
        factor, power = calibrated[RANDOM if rule == RANDOM else SUMS][rows]
        self._factor = np.float32(factor * ratio**power)
        self._mask = mask
        self._mean, self._changes = np.zeros((2, *mask.shape), dtype=np.float32)

    def update(self, forces: Floats, residual: float) -> Floats:
        """Process a reconstructed frame.

        Parameters
        ----------
        forces : ndarray of float32, shape (n_rows, n_cols)
            Newtons.
        residual : float
            RMS of its residual, newtons.

        Returns
        -------
        ndarray of float32, shape (n_rows, n_cols)
            Standard deviation of each force, newtons; the caller's own. Forces are not normal:
            90 % of the true ones lie within 1.645 of it, not 68 % within one.
        """
        r = np.float32(max(residual, LEAST_RESIDUAL))
        self._add_change(forces)
        p = (self._changes + CHANGE_FLOOR * r * r) / (forces + FORCE_FLOOR * r)
        q = np.sqrt(np.square(_roughness(forces)) + r * r)
        sd: Floats = self._factor * np.sqrt(r * np.sqrt(p * q))
        sd[~self._mask] = 0
        return sd

    def _add_change(self, forces: Floats) -> None:
        """Update both means, excluding a change of all forces by the same factor."""
        # The factor by which the mean is nearest to the forces.
        power = float(np.vdot(self._mean, self._mean))
        gain = 1.0
        if power > 0:
            gain = float(np.vdot(forces, self._mean)) / power
        # Squares of tiny forces are 0, or overflow in the quotient.
        if not math.isfinite(gain):
            gain = 1.0
        mean = np.float32(gain) * self._mean
        change = forces - mean
        self._mean = mean + MEAN_RATE * change
        self._changes += RATE * (np.square(change) - self._changes)


def _roughness(forces: Floats) -> Floats:
    """Return the sum of both absolute differences to the next taxels, averaged over 3 x 3."""
    down = np.diff(forces, axis=0, append=forces[-1:])
    right = np.diff(forces, axis=1, append=forces[:, -1:])
    edged = np.pad(np.abs(down) + np.abs(right), 1, mode="edge")
    three = edged[:-2] + edged[1:-1] + edged[2:]
    rough: Floats = (three[:, :-2] + three[:, 1:-1] + three[:, 2:]) / 9
    return rough
