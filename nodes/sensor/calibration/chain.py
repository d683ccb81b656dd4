"""From raw readings to forces: baseline, gains, response curve, drift, mask, range."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sparseskin.messages.ranges import is_whole
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import RefusedError
from sparseskin.nodes.numerics.arrays import AnyArray, Doubles, Floats, Mask
from sparseskin.nodes.sensor.repetition import line_on_still
from sparseskin.nodes.sensor.saturation import Clipped

from .description import SkinDescription
from .drift import DRIFT_RATE, Drift

MOVED = 0.05
"""Change of a taxel's force by a tare above which it is reported, in parts of f_max; chosen."""
TARE_FRAMES = 30
"""Frames of a tare unless stated otherwise, chosen: their median has a quarter of their noise."""
MAX_TARE_FRAMES = 10_000
MAX_TARE_READINGS = 1 << 26
"""Most readings of a tare, chosen: 256 MiB."""
LEAST_FRAMES = 10
MOST_FRAMES = 100
"""Frames of a tare that its noise is measured on, where none is stated. Chosen: the median over
the taxels of its deviation."""


class Chain:
    """Converts the raw readings of one skin to forces, and takes tares while frames pass.

    A raw reading c of a taxel becomes f = clip(R(g (c - b)) - w, f_min, f_max): see
    `SkinDescription`, w is the drift; 0 in masked cells. Hysteresis is not modelled: a reading that
    comes back slowly after a press shows as a force.

    Parameters
    ----------
    drift_rate : float
        Largest rate of the drift that is followed, in parts of f_max a second; 0: none is.
    tare : int
        Frames of a tare at the start, which are not converted; 0: none. RefusedError if they would
        not fit in memory.
    log : callable
        Receives one line of text on each tare.
    """

    def __init__(
        self,
        description: SkinDescription,
        drift_rate: float = DRIFT_RATE,
        tare: int = 0,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.description = description  # with the baseline in use; it contains no drift
        self.skin: Skin = description.skin
        noise = description.noise or 0.0
        self.drift = Drift(description.shape, description.f_max, noise, drift_rate)
        # Readings above f_max, and below f_min by more than noise.
        self.clipped = Clipped(mask=self.skin.mask)
        self._previous: Doubles | None = None
        self._untared: Mask = np.zeros(description.shape, np.bool_)
        self._log = log
        #: True while the tare at the start waits for frames.
        self.is_starting = tare > 0
        #: True once a tare has changed the baseline, until whoever publishes it sets it to False.
        self.is_news = False

        self._tared = ""  # the last tare, in words
        self._tare_left = 0  # frames that it still waits for
        self._taring: list[AnyArray] = []
        if tare:
            self.start_tare(tare)

    def process(self, raw: AnyArray, stamp_ns: int) -> Floats | None:
        """Return the forces of a frame as `apply`; None for one of the tare at the start."""
        if self._tare_left:
            self._taring.append(np.array(raw, dtype=np.float32))
            self._tare_left -= 1
            if not self._tare_left:
                self.tare(self._taring)
                self._taring = []

        # A touch as the graph starts is not converted with a baseline that is not known yet.
        if self.is_starting:
            self.is_starting = self._tare_left > 0
            return None
        return self.apply(raw, stamp_ns)

    def apply(self, raw: AnyArray, stamp_ns: int) -> Floats:
        """Forces of a frame in the skin's unit, a fresh float32 array (rows, cols) in [f_min,
        f_max], NaN where the reading, or that of the tare, is missing.

        `raw` are its readings, any real dtype, NaN where they are missing; `stamp_ns` is its time.
        """
        description = self.description
        forces = description.forces(raw)
        forces[self._untared] = np.nan

        # On a skin with noise, a frame that repeats the last one is of a board that hangs: what is
        # followed meanwhile would be no drift, and its frames would differ.
        hangs = False
        if self._previous is not None:
            hangs = np.array_equal(forces, self._previous, equal_nan=True)
        self._previous = forces.copy() if description.noise else None

        forces -= self.drift.value
        if not hangs:
            self.drift.update(np.nan_to_num(forces), stamp_ns)

        # Counted before they are clipped.
        f_min = description.f_min
        f_max = description.f_max
        self.clipped.add(forces, f_min, f_max, description.noise or 0.0)
        np.clip(forces, f_min, f_max, out=forces)
        return forces.astype(np.float32)

    def start_tare(self, value: Any) -> str:
        """Begin a tare of the next `value` frames, `TARE_FRAMES` if None; one under way is
        forgotten. Return what follows, in words; RefusedError if that is no number of frames
        allowed, or they would not fit in memory.
        """
        n_frames = TARE_FRAMES if value is None else value
        if not is_whole(n_frames, 1, MAX_TARE_FRAMES):
            raise RefusedError(
                f"tare: {str(value)[:40]!r} is no number of frames (allowed: "
                f"1..{MAX_TARE_FRAMES})"
            )
        n_cells = self.description.n_rows * self.description.n_cols
        limit = MAX_TARE_READINGS // n_cells
        if n_frames > limit:
            raise RefusedError(f"tare: {n_frames} frames of this skin; at most {limit}")

        self._taring = []
        self._tare_left = n_frames
        return f"the baseline becomes the median of the next {n_frames} frames"

    def tare(self, frames: Sequence[AnyArray]) -> None:
        """Take the median of one or more untouched frames for the baseline, forget the drift, and
        log how much the forces of the untouched skin changed. A taxel whose reading is missing in
        all of them has no baseline, and no force until the next tare. Noise that is not stated is
        that of these frames.
        """
        readings = np.array(frames)
        missing = np.isnan(readings)
        self._untared = missing.all(axis=0)
        # nanmedian warns of columns of NaN alone, and is slower where there is none.
        readings[:, self._untared] = 0.0
        median = np.nanmedian if missing.any() else np.median
        medians = median(readings, axis=0).astype(np.float64)

        old_baseline = self.description.baseline
        old_values = 0.0 if old_baseline is None else old_baseline
        baseline = np.where(self._untared, old_values, medians)

        # How far the untouched skin was off with the baseline and the drift until now.
        untouched_forces = self.description.forces(baseline) - self.drift.value
        moved = np.abs(untouched_forces)[self.skin.exists]
        self.description = replace(self.description, baseline=baseline)
        self.drift.reset()
        self.clipped.sign.reset()
        if self.description.noise is None and len(frames) >= LEAST_FRAMES:
            self._measure_noise(readings[:MOST_FRAMES])

        # Without an old baseline all forces change.
        line = f"forces changed by at most {moved.max():.3g} {self.skin.unit}"
        n_moved = np.count_nonzero(moved > MOVED * self.skin.f_max)
        if n_moved and old_baseline is not None:
            line += f", of {n_moved} taxels by more than {100 * MOVED:g} % of the range"
            line += ": a touch while taring, or a baseline that was old"
        still = line_on_still(readings, self.skin.exists & ~self._untared)
        if still:
            line += f"; {still}"
        self._tared = line
        self.is_news = True
        self._log(f"tared: {line}")

    def invert(self) -> None:
        """Let readings fall with force that rose with it, or the reverse."""
        self.description = self.description.inverted()
        self.drift.reset()
        self.clipped.sign.reset()
        self.is_news = True

    def _measure_noise(self, readings: AnyArray) -> None:
        """State the noise of untouched frames, unless it is so large that they were touched."""
        works = self.skin.exists & ~self._untared
        frames = [self.description.forces(frame)[works] for frame in readings]
        forces = np.stack(frames)
        has_all = ~np.isnan(forces).any(axis=0)
        if not has_all.any():
            return

        deviations = forces[:, has_all].std(axis=0, ddof=1)
        noise = float(np.median(deviations))
        if not 0 < noise < MOVED * self.skin.f_max:
            return
        rounded = float(f"{noise:.3g}")
        self.description = replace(self.description, noise=rounded)
        # Its thresholds are in standard deviations of the noise.
        shape = self.description.shape
        self.drift = Drift(shape, self.description.f_max, noise, self.drift.rate)

    def state(self) -> dict[str, Any]:
        """State for the operator: frames that a tare waits for, largest drift, last tare."""
        drift = float(np.abs(self.drift.value).max())
        state: dict[str, Any] = {
            "tare_left": self._tare_left,
            "drift": float(f"{drift:.3g}"),
        }
        if self._tared:
            state["tared"] = self._tared
        return state
