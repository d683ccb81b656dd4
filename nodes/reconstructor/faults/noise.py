"""The noise of measurements beside the one that the skin states."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Doubles, Floats

QUIET = 0.25
"""Part of the stated noise variance below which measurements lack noise. Chosen."""
SHOWN = 0.5
"""The same that shows that the stated noise is that of the skin. Chosen."""
LEARNING = 20
"""Frames that show it. Chosen."""
RATE = 0.1
"""Rate per frame of the mean of the innovations, in the variance that the skin states."""
LARGEST = 4.0
"""Largest squared innovation of a frame, in the same, that counts: more is a motion."""

LONG = 50
"""Frames of pressed taxels by which their noise is averaged: that of a skin does not change."""
AT_LEAST = 0.7
"""Part of the measured noise of pressed taxels that each of them has at least. Chosen."""


class NoiseWatch:
    """Follows the innovations of frames, in the noise that the skin states.

    Attributes
    ----------
    is_shown : bool
        True once the skin has shown the noise that it states: one that states too much, or whose
        untouched taxels read 0, never does.
    is_present : bool
        True while it has shown it, and has it.
    is_quiet : bool
        True while it has shown it, and lacks it now: measurements are scaled down, or repeat.
    """

    def __init__(self) -> None:
        self._ratio = 0.0
        self._n_shown = 0
        self.is_shown = False
        self.is_present = False
        self.is_quiet = False

    def look(self, innovation2: float, stated: float) -> None:
        """Process the mean squared innovation of a frame, and the least noise variance of a
        measurement that the skin states.
        """
        ratio = min(innovation2 / stated, LARGEST)
        self._ratio += RATE * (ratio - self._ratio)
        if self._ratio > SHOWN:
            self._n_shown += 1
        self.is_shown = self._n_shown >= LEARNING
        self.is_present = self.is_shown and self._ratio > SHOWN
        self.is_quiet = self.is_shown and self._ratio < QUIET


class PressedNoise:
    """Measures the noise of pressed taxels on a skin that does not state it.

    What the noise of measurements exceeds that of an untouched skin by is that of pressed taxels.
    It is taken to rise as the square of the force, and not beyond that of their mean square.
    """

    def __init__(self) -> None:
        self._n_frames = 0
        # Number of pressed taxels, their excess noise, squared forces.
        self._means = (0.0, 0.0, 0.0)

    def look(self, pressed: Floats, excess: float) -> None:
        """Process the forces of the pressed taxels of a frame, and what the noise variance of all
        taxels together exceeds that of an untouched skin by.
        """
        self._n_frames = min(self._n_frames + 1, LONG)
        forces2 = float(np.square(pressed, dtype=np.float64).sum())
        of_frame = len(pressed), excess, forces2
        n = self._n_frames
        n_pressed, mean_excess, mean_forces2 = (
            mean + (now - mean) / n for mean, now in zip(self._means, of_frame, strict=True)
        )
        self._means = n_pressed, mean_excess, mean_forces2

    def variance(self, forces: Floats, untouched: float) -> Doubles:
        """Return the noise variance of taxels by their forces, float64 (n,); `untouched` is that of
        an untouched one.
        """
        n_pressed, excess, forces2 = self._means
        part = np.minimum(np.square(forces, dtype=np.float64) * n_pressed / (forces2 + TINY), 1)
        variance: Doubles = AT_LEAST * (untouched + part * excess / (n_pressed + TINY))
        return variance
