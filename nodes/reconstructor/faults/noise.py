"""The noise of measurements beside the one that the skin states."""

from __future__ import annotations

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
