"""What the other phases of rotating rows have measured, as far as it still holds."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.reconstructor.projection import Projection

#: The most that a row counts that an earlier frame has read, where one of this frame counts 1.
#: With more, the noise of earlier frames, which the estimate has averaged out, comes back.
MOST = 0.3
#: Change since a row was read, in noise variances, that is not told from noise; how fast rows
#: count less where there is more.
UNDOUBTED, DOUBTING = 1.05, 10.0
TINY = 1e-30


class RowMemory:
    """Lets a frame be restored from the rows of earlier frames too, while they hold.

    What the last estimate leaves unexplained of a row, noise or a touch too weak for one frame,
    is lost with the frame. Here each row of W keeps what was measured of it; a prediction that
    moves moves it along. In a frame such a row counts by

        w = 0.3 / sqrt(1 + 10 D)

    D being how much the rows of this frame have changed since they were read last, in noise
    variances. So a still skin is restored from all of W, one that moves from the frame alone.

    Parameters
    ----------
    projection : Projection
        One that has `whole`.
    m : int
        Number of measurements.
    whole : ndarray of float32, shape (n_rows,)
        W x of the last estimate when a frame is recalled; becomes that of its prediction.

    Attributes
    ----------
    read : ndarray of float32, shape (n_rows,)
        1 for the rows of this frame, 0 for others.
    m_counted : float
        Sum of the squares of what rows count: as many measurements they are worth.
    """

    def __init__(self, projection: Projection, m: int, whole: Floats) -> None:
        self._projection = projection
        self._m = m
        self.m_counted = float(m)
        self._read_by: dict[int, Floats] = {}
        floats = [np.zeros(projection.n_rows, dtype=np.float32) for _ in range(5)]
        self.read, self._known, self._values, self._rows, self._weights = floats
        self._whole = whole
        self._factors = np.zeros(3, dtype=np.float32)
        self.forget()

    def forget(self) -> None:
        """Let no earlier frame count."""
        self._phases: set[int] = set()
        self._known.fill(0)
        self._values.fill(0)

    def recall(
        self,
        phase: int,
        x: Floats | None,
        y: Floats,
        weight: float,
        s2: float,
        surprise: float,
        target: Floats,
    ) -> None:
        """Let the projection weigh the rows, and set what the iterations aim at.

        Parameters
        ----------
        phase : int
            Number of the phase that has read y.
        x : ndarray of float32, shape (n,), or None
            Prediction of the frame; None where it is the last estimate.
        y : ndarray of float32, shape (n_rows,)
            Measurements, a vector of rows.
        weight : float
            K, how far the target goes from the prediction to what was measured.
        s2 : float
            Variance of the noise on a measurement.
        surprise : float
            Mean square of the misfit, in noise variances: where a phase is read for the first
            time, all of it may be change.
        target : ndarray of float32, shape (n_rows,)
            Becomes w (W x + K (measured - W x)).
        """
        if phase not in self._read_by:
            self._read_by[phase] = (self._projection.measured > 0).astype(np.float32)
        self.read = self._read_by[phase]
        change2 = self._compare(x, y)
        change = surprise - UNDOUBTED
        if phase in self._phases:
            change = change2 / (self._m * s2 + TINY) - 2 * UNDOUBTED
        counted = MOST / math.sqrt(1 + DOUBTING * max(0.0, change))
        self._phases.add(phase)
        self.m_counted = self._m * (1 + counted**2 * (len(self._phases) - 1))
        self._follow(weight, counted, target)

    def _compare(self, x: Floats | None, y: Floats) -> float:
        """Move what is known along and take y in; how far it was from y, squared."""
        whole, rows, values = self._whole, self._rows, self._values
        if x is not None:
            self._projection.whole(x, rows)
            np.subtract(rows, whole, whole)
            np.add(values, whole, values)
            np.copyto(whole, rows)
        np.subtract(y, values, rows)
        np.multiply(rows, self.read, rows)
        np.add(values, rows, values)
        return float(np.dot(rows, rows))

    def _follow(self, weight: float, counted: float, target: Floats) -> None:
        """Set the target and the weights of rows, `counted` being that of earlier frames."""
        self._factors[:] = weight, counted, 1 - counted
        k, w, rest = self._factors[:, None]
        np.maximum(self._known, self.read, out=self._known)
        np.multiply(self._known, w, self._weights)
        np.multiply(self.read, rest, self._rows)
        np.add(self._weights, self._rows, self._weights)
        np.subtract(self._values, self._whole, target)
        np.multiply(target, k, target)
        np.add(target, self._whole, target)
        np.multiply(target, self._weights, target)
        self._projection.weigh(self._weights)
