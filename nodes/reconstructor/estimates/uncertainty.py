"""The standard deviation of each reconstructed force."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.phi.base import RANDOM, SPREAD
from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING
from sparseskin.nodes.numerics.arrays import Floats, Mask

#: Rates of the running mean of forces, and of squared changes: an estimate that lags behind a slow
#: slide changes little from frame to frame.
MEAN_RATE, RATE = 0.25, 0.2
#: Part of the RMS residual added to the change, squared, and to the force: taxels that stand still
#: or are untouched are not certain.
CHANGE_FLOOR, FORCE_FLOOR = 0.03, 0.3
#: By solver, rule of the rows of Phi, and fixed rows or rotating ones: factor a, and power b of
#: N / M. Fitted on random scenes at N/3, N/4 and N/8, so that bands of 1.645 deviations hold 90 %
#: of the touched taxels, by the geometric mean over the scenes.
CALIBRATED = {
    "skin": {
        SPREAD: {FIXED: (1.3, 0.11), ROTATING: (1.31, 0.2)},
        RANDOM: {FIXED: (0.82, 0.65), ROTATING: (1.13, 0.35)},
    },
    "fista": {
        SPREAD: {FIXED: (1.58, 0.72), ROTATING: (1.87, 0.5)},
        RANDOM: {FIXED: (1.55, 0.8), ROTATING: (1.55, 0.8)},
    },
}
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
    solver : str
        One of `CALIBRATED`.
    rows : str
        "fixed" or "rotating": with fixed rows, errors that none of them measures persist.
    rule : int
        Rule of the rows, as in `Phi`.
    """

    def __init__(
        self, mask: Mask, ratio: float, solver: str, rows: str = FIXED, rule: int = SPREAD
    ) -> None:
        factor, power = CALIBRATED[solver][rule][rows]
        self._factor = factor * ratio**power
        self._nowhere = None if mask.all() else ~mask
        n_rows, n_cols = mask.shape
        vectors = np.zeros((4, n_rows, n_cols), dtype=np.float32)
        self._mean, self._changes, self._p, self._q = vectors
        self._edged, self._rough, self._spare = np.zeros(
            (3, n_rows + 2, n_cols + 2), dtype=np.float32
        )

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
        r = max(residual, LEAST_RESIDUAL)
        p = self._p
        self._add_change(forces)
        np.add(self._changes, np.float32(CHANGE_FLOOR * r * r), out=p)
        q = self._roughness(forces)
        np.square(q, out=q)
        q += np.float32(r * r)
        np.sqrt(q, out=q)
        p *= q
        p /= np.add(forces, np.float32(FORCE_FLOOR * r), out=q)
        np.sqrt(p, out=p)
        p *= np.float32(self._factor**2 * r)
        if self._nowhere is not None:
            p[self._nowhere] = 0
        sd: Floats = np.sqrt(p)
        return sd

    def _add_change(self, forces: Floats) -> None:
        """Update both means, excluding a change of all forces by the same factor."""
        mean, change, changes = self._mean, self._p, self._changes
        power = float(np.vdot(mean, mean))
        gain = float(np.vdot(forces, mean)) / power if power > 0 else 1.0
        if not math.isfinite(gain):
            gain = 1.0
        mean *= np.float32(gain)
        np.subtract(forces, mean, out=change)
        mean += np.multiply(change, np.float32(MEAN_RATE), out=self._q)
        np.square(change, out=change)
        change -= changes
        change *= np.float32(RATE)
        changes += change

    def _roughness(self, forces: Floats) -> Floats:
        """Return the sum of both absolute differences to the next taxels, averaged over 3 x 3."""
        # Flat rows with their edges: all sums but the last are of long vectors, which is faster.
        edged, rough, spare = self._edged, self._rough, self._spare
        width = edged.shape[1]
        _fill(edged, forces)
        flat, down, right = edged.reshape(-1), rough.reshape(-1), spare.reshape(-1)
        np.subtract(flat[width:], flat[:-width], out=down[:-width])
        np.subtract(flat[1:], flat[:-1], out=right[:-1])
        np.abs(down, out=down)
        down += np.abs(right, out=right)
        _fill(rough, rough[1:-1, 1:-1])
        three = right
        np.add(down[: -2 * width], down[width:-width], out=three[width:-width])
        three[width:-width] += down[2 * width :]
        np.add(three[:-2], three[1:-1], out=down[1:-1])
        down[1:-1] += three[2:]
        np.multiply(rough[1:-1, 1:-1], np.float32(1 / 9), out=self._q)
        return self._q


def _fill(edged: Floats, middle: Floats) -> None:
    """Set the inside of an array, and its edges to the values next to them."""
    edged[1:-1, 1:-1] = middle
    edged[0], edged[-1] = edged[1], edged[-2]
    edged[:, 0], edged[:, -1] = edged[:, 1], edged[:, -2]
