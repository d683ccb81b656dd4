"""Moving average over frames, as the simulated recordings were smoothed."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.sensor.source import Forces


class MovingAverage:
    """Mean of the newest `width` frames; frames before the first count as 0.

    Parameters
    ----------
    width : int
        How many frames, 1 or more.
    shape : (n_rows, n_cols)
        Shape of a frame.

    Notes
    -----
    Source: paper, section II-B: "a moving average filter with a width of 10 time-steps".
    """

    def __init__(self, width: int, shape: tuple[int, int]) -> None:
        self._ring = np.zeros((width, *shape), dtype=np.float32)
        self._oldest = 0

    @property
    def newest(self) -> Forces:
        """The slot of the next frame, to be written before `step`; float32, shape `shape`."""
        slot: Forces = self._ring[self._oldest]
        return slot

    def step(self) -> Forces:
        """Take the frame written to `newest` and return the mean.

        Returns
        -------
        ndarray of float32, shape (n_rows, n_cols)
            A fresh array. Summed anew each time, so that no rounding is carried along and a
            taxel that was not touched during `width` frames is exactly 0.
        """
        width = len(self._ring)
        self._oldest = (self._oldest + 1) % width
        mean: Forces = self._ring.sum(axis=0)
        mean *= np.float32(1.0 / width)
        return mean
