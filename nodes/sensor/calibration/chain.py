"""From raw readings to forces: baseline, gains, response curve, drift, mask, range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.skin import Skin
from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.sensor.saturation import Clipped

from .description import SkinDescription
from .drift import DRIFT_RATE, Drift

MOVED = 0.05
"""Change of a taxel's force by a tare above which it is reported, in parts of f_max; chosen."""


class Chain:
    """Converts the raw readings of one skin to forces.

    A raw reading c of a taxel becomes

        f = clip(R(g (c - b)) - w, f_min, f_max),

    b the baseline, g the gain, R the response curve, w the drift; 0 in masked cells. Hysteresis is
    not modelled: a reading that comes back slowly after a press shows as a force.

    Parameters
    ----------
    description : SkinDescription
        The skin.
    drift_rate : float
        Largest rate of the drift that is followed, in parts of f_max a second; 0: none is.

    Attributes
    ----------
    description : SkinDescription
        The skin, with the baseline in use; it contains no drift.
    skin : Skin
        Geometry and range of the forces.
    drift : Drift
        The drift that is followed.
    clipped : Clipped
        Readings above f_max, and below f_min by more than noise, so far.
    """

    def __init__(self, description: SkinDescription, drift_rate: float = DRIFT_RATE) -> None:
        self.description = description
        self.skin: Skin = description.skin
        d = description
        self.drift = Drift(d.shape, d.f_max, d.noise or 0.0, drift_rate)
        self.clipped = Clipped()
        self._last: Doubles | None = None

    def apply(self, raw: npt.NDArray[Any], stamp_ns: int) -> Floats:
        """Return the forces of a frame.

        Parameters
        ----------
        raw : ndarray of a real number, shape (rows, cols)
            Raw readings, finite where a taxel exists; not modified.
        stamp_ns : int
            Time of the frame, nanoseconds.

        Returns
        -------
        ndarray of float32, shape (rows, cols)
            A fresh array in [f_min, f_max], in the skin's unit.
        """
        d = self.description
        found = self.unclipped(raw)
        # On a skin with noise, a frame that repeats the last one is of a board that hangs: what is
        # followed meanwhile would be no drift, and its frames would differ.
        hangs = self._last is not None and np.array_equal(found, self._last)
        self._last = found.copy() if d.noise else None
        found -= self.drift.value
        if not hangs:
            self.drift.update(found, stamp_ns)
        self.clipped.add(found, d.f_min - self.drift.threshold, d.f_max)
        return np.clip(found, d.f_min, d.f_max, out=found).astype(np.float32)

    def unclipped(self, raw: npt.NDArray[Any]) -> Doubles:
        """Forces of raw readings, shape (..., rows, cols), without drift and range."""
        d = self.description
        found: Doubles = np.array(raw, dtype=np.float64)
        if d.baseline is not None:
            found -= d.baseline
        if d.gains is not None:
            found *= d.gains
        if d.response is not None:
            found = d.response.forces(found)
        if self.skin.mask is not None:
            found[..., ~self.skin.mask] = 0.0
        return found

    def tare(self, frames: Sequence[npt.NDArray[Any]]) -> str:
        """Take the median of one or more untouched frames for the baseline, and forget the drift;
        return in words how much the forces of the untouched skin changed.
        """
        baseline = np.median(np.asarray(frames), axis=0).astype(np.float64)
        moved = np.abs(self.unclipped(baseline) - self.drift.value)[self.skin.exists]
        self.description = replace(self.description, baseline=baseline)
        self.drift.reset()
        line = f"forces changed by at most {moved.max():.3g} {self.skin.unit}"
        if n_moved := np.count_nonzero(moved > MOVED * self.skin.f_max):
            line += f", of {n_moved} taxels by more than {100 * MOVED:g} % of the range"
            line += ": a touch while taring, or a baseline that was old"
        return line
