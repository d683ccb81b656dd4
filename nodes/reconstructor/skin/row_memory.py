"""Measurements of the other row subsets of rotating rows, as far as they still hold."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Floats
from sparseskin.nodes.reconstructor.solvers.projection import Projection

from .tuning import TUNING, SkinTuning


class RowMemory:
    """Measurements of earlier frames, used in a frame with less weight while they still hold.

    The residual of a row, noise or a touch too weak for one frame, is lost with its frame. Here
    each row of W keeps its last measurement, moved along with the prediction. In a frame such a
    row has the weight

        w = 0.3 / sqrt(1 + 10 D)

    D being the change of this frame's rows since they were read last, in noise variances. So a
    still skin is reconstructed from all of W, one that moves from the frame alone.

    Parameters
    ----------
    projection, m
        One that has `whole`; number of measurements.
    whole : ndarray of float32, shape (n_rows,)
        W x of the last estimate when `compare` is called; becomes that of the prediction.
    tuning : SkinTuning
        The constants.

    Attributes
    ----------
    read : ndarray of float32, shape (n_rows,)
        1 for the rows of this frame, 0 for others.
    m_counted : float
        Sum of the squared weights: the equivalent number of measurements.
    values, known : ndarray of float32, shape (n_rows,)
        Last measurement of each row, moved along, newtons; 1 where there is one, 0 where not.
    """

    def __init__(
        self, projection: Projection, m: int, whole: Floats, tuning: SkinTuning = TUNING
    ) -> None:
        self._t = tuning
        self._projection = projection
        self._m = m
        self.m_counted = float(m)
        self._read_by: dict[int, Floats] = {}
        floats = [np.zeros(projection.n_rows, dtype=np.float32) for _ in range(5)]
        self.read, self.known, self.values, self._rows, self._weights = floats
        self._whole = whole
        self._factors = np.zeros(3, dtype=np.float32)
        self.forget()

    def forget(self) -> None:
        """Forget the measurements of all earlier frames."""
        self.forget_times()
        self.known.fill(0)
        self.values.fill(0)

    def forget_times(self) -> None:
        """Forget when rows were read, and how much they change; their values are kept."""
        #: Number of the frame that each row subset was last read in, the latest last.
        self._read_in: dict[int, int] = {}
        self._n_frames = 0
        self._drift = 0.0

    def counted(self, subset: int, change2: float, s2: float, e2: float, settling: bool) -> float:
        """Return the weight of rows of earlier frames.

        Parameters
        ----------
        subset : int
            Number of the row subset of this frame.
        change2 : float
            Squared change of its rows since they were read last, as `compare` returned it.
        s2, e2 : float
            Noise variance, and mean squared innovation: the change of a row subset that is read
            for the first time.
        settling : bool
            True if only the rows of this frame are to have a weight.
        """
        self._read_by[subset] = self._projection.read
        self._n_frames += 1
        change, age = e2 - s2, 1
        if subset in self._read_in:
            change = change2 / self._m - 2 * s2
            age = self._n_frames - self._read_in.pop(subset)
        change = max(0.0, change)
        self._drift = max(change / age, self._t.drift_decay * self._drift)
        counted = (
            0.0
            if settling
            else self._t.memory_weight / math.sqrt(1 + self._t.memory_decay * change / (s2 + TINY))
        )
        self._read_in[subset] = self._n_frames
        self.m_counted = self._m * (1 + counted**2 * (len(self._read_in) - 1))
        return counted

    def variances(self, noise: float) -> Floats:
        """Return the variance of each row, float32 (n_rows,), squared newtons.

        `noise` is that of a row of this frame; for earlier ones their expected change is added.
        """
        variances = np.zeros_like(self.values)
        for subset, frame in self._read_in.items():
            changed = self._t.memory_doubt * self._drift * (self._n_frames - frame)
            variances[self._read_by[subset] > 0] = noise + changed
        return variances

    def compare(self, x: Floats | None, y: Floats) -> float:
        """Move the known rows along, replace those of y; return their squared change.

        x is the prediction of the frame, float32 (n,), None where it is the last estimate; y are
        its measurements as a vector of rows, float32 (n_rows,).
        """
        self.read = self._projection.read
        whole, rows, values = self._whole, self._rows, self.values
        if x is not None:
            self._projection.whole(x, rows)
            np.subtract(rows, whole, whole)
            np.add(values, whole, values)
            np.copyto(whole, rows)
        np.subtract(y, values, rows)
        np.multiply(rows, self.read, rows)
        np.add(values, rows, values)
        return float(np.dot(rows, rows))

    def follow(self, gain: float, counted: float, target: Floats) -> None:
        """Set the target and the weights of rows, `counted` for those of earlier frames.

        The target, float32 (n_rows,), becomes w (W x + K (measured - W x)) with the gain K.
        """
        self._factors[:] = gain, counted, 1 - counted
        k, w, rest = self._factors[:, None]
        np.maximum(self.known, self.read, out=self.known)
        np.multiply(self.known, w, self._weights)
        np.multiply(self.read, rest, self._rows)
        np.add(self._weights, self._rows, self._weights)
        np.subtract(self.values, self._whole, target)
        np.multiply(target, k, target)
        np.add(target, self._whole, target)
        np.multiply(target, self._weights, target)
        self._projection.weigh(self._weights)
