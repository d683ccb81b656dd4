"""First touch of a patch, seen in its measurements before any solving.

Untouched, the measurements of a row subset are Phi times the mean of untouched readings, and noise:
both follow from the noise that the skin states. The statistic is that of `Departures`, for positive
scores alone, in windows of 1, 2, 4 ... frames up to two cycles of the rows: a strong touch shows in
one frame, a weak one in several. At most `FALSE_TOUCHES` a frame are false, if the noise is as
stated.

Where it is not, as of a skin with an offset, a touch without any contact lasts: the mean of later
frames then takes the place of the stated one, until measurements fall below it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.nodes.compressor.departures import CLIPPED_MEAN, Departures, Windows
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.noise import CLIPPED

FALSE_TOUCHES = 1e-7
"""False touches a frame and patch, untouched. Chosen: one in 10 million."""
CYCLES = 2
"""Cycles of the rows in the longest window, and after which a touch is over that no longer shows.
Chosen: the noise of more is less than a fifth of the least threshold of a contact."""
LEARNT = 8
"""Frames of each row subset in a reference that takes the place of the stated one. Chosen."""
ALONE = 16
"""Longest windows after which a touch without a contact is none. Chosen."""


class Touch(NamedTuple):
    """What the measurements of a frame show.

    `touched`: False if noise alone explains them; None: not known. `begins`: True in the first
    frame of a touch; `is_new`: True in its first frames, of one window.
    """

    touched: bool | None = None
    begins: bool = False
    is_new: bool = False


UNKNOWN = Touch()


class TouchTest:
    """What all patches of a node share: expected measurements of an untouched skin, and bounds.

    Parameters
    ----------
    skin : SkinState
        It states noise.
    phis : sequence of Phi
        One a row subset.
    false_touches : float, optional
        Probability of a false touch a frame, untouched; by default `FALSE_TOUCHES`.

    Attributes
    ----------
    span : int
        Frames of the longest window.
    """

    def __init__(
        self,
        skin: SkinState,
        phis: Sequence[Phi],
        false_touches: float | None = None,
    ) -> None:
        n_windows = 1 + (CYCLES * len(phis) - 1).bit_length()
        self.span = 1 << (n_windows - 1)
        self.n_windows = n_windows
        self.subsets = {phi.fingerprint: k for k, phi in enumerate(phis)}
        self.departures = Departures(
            skin,
            false_touches or FALSE_TOUCHES,
            phis,
            n_windows=n_windows,
            one_sided=True,
        )
        variance = skin.sigma_end**2
        mean = 0.0
        if skin.clips_noise:
            mean = CLIPPED_MEAN * skin.sigma_end
            variance *= CLIPPED
        self.variance = variance
        readings = np.full(phis[0].n, mean, dtype=np.float32)
        expected = [phi.forward(readings) for phi in phis]
        self.expected = np.stack(expected)
        untouched = np.zeros((1, skin.n_rows, skin.n_cols), dtype=np.float32)
        self.bounds = self.departures.bounds(untouched)

    def windows(self, n_patches: int = 1) -> Windows:
        """Windows of the scores of some patches."""
        n = self.departures.pyramid.n
        return Windows(n_patches, n, self.n_windows, len(self.subsets))


class TouchWatch:
    """Finds the touches of one patch.

    Attributes
    ----------
    touch : Touch
        That of the frame that was read last.
    """

    def __init__(self, test: TouchTest) -> None:
        self.test = test
        self.touch = UNKNOWN
        self._windows = test.windows()
        self._in_contact = False
        self._touched = False
        #: Frames since the last alarm, and since the touch began.
        self._n_calm = 0
        self._n_touched = 0
        self._use_stated()

    def _use_stated(self) -> None:
        """Compare with the stated mean of untouched readings from now on."""
        self._reference = self.test.expected
        #: Variance of the reference in that of a frame.
        self._noise = np.zeros(1)
        self._below: Windows | None = None
        self._n_learnt: list[int] = []

    def read(self, phi: Phi, y: Floats | None, step: float) -> None:
        """Look at the measurements of a frame, float32 (m,); None: they hold nothing of the skin.
        `step` is that of quantised ones, in their unit, 0 of others.
        """
        subset = self.test.subsets.get(phi.fingerprint)
        # A contact is a touch, whatever else is measured.
        if self._in_contact:
            self._touched = True
            self.touch = Touch(touched=True)
            return
        # Errors of rounding are like noise while the noise fills a step.
        if y is None or subset is None or step**2 > self.test.variance:
            self.touch = UNKNOWN
            return
        if self._n_learnt:
            self._learn(subset, y)
            self.touch = UNKNOWN
            return

        is_touch = self._alarm(subset, y, step)
        was_touched = self._touched
        self._n_calm += 1
        if is_touch:
            self._n_calm = 0
        self._n_touched += 1
        if not was_touched:
            self._n_touched = 0
        # So long without a contact: what was stated of untouched readings is no longer so.
        if self._n_touched >= ALONE * self.test.span:
            self._restart()
            return
        touched = is_touch or (was_touched and self._n_calm < self.test.span)
        self._touched = touched
        # That of a reference which was learnt excludes no contact.
        is_sure = touched or self._below is None
        self.touch = Touch(
            touched=touched if is_sure else None,
            begins=touched and not was_touched,
            is_new=touched and self._n_touched < self.test.span,
        )

    def skip(self) -> None:
        """Let a frame pass whose measurements were not sent or have not changed."""
        self.touch = self.touch._replace(begins=False)

    def follow(self, in_contact: bool) -> None:
        """Note if the patch is in contact after the frame that was read last."""
        if self._in_contact and not in_contact:
            self._windows.restart()
            self._n_calm = 0
            self._n_touched = 0
        self._in_contact = in_contact

    def _alarm(self, subset: int, y: Floats, step: float) -> bool:
        """True if noise does not explain the measurements of a frame."""
        test = self.test
        departures = test.departures
        change = y - self._reference[subset]
        difference = change[np.newaxis]
        # The error of rounding is nearly uniform.
        noise = test.variance / (test.variance + step**2 / 12)
        scores = departures.scores(difference, subset)
        scores *= np.float32(np.sqrt(noise))
        limits = test.bounds.scores
        alarms = self._windows.alarms(scores, limits, self._noise, one_sided=True)
        if self._below is not None:
            below = self._below.alarms(-scores, limits, self._noise, one_sided=True)
            # A change of one sign has smaller scores of the other one elsewhere.
            falls = not alarms[0] or -scores.min() > scores.max()
            if below[0] and falls:
                self._windows.restart()
                self._use_stated()
                return False
        energy = noise * departures.energy(difference, test.bounds)
        alarms |= energy > test.bounds.energy * (1 + self._noise)
        return bool(alarms[0])

    def _restart(self) -> None:
        """Learn a reference from the frames that follow."""
        self._n_learnt = [0] * len(self.test.subsets)
        self._reference = np.zeros_like(self.test.expected)
        self._windows.restart()
        self._touched = False
        self.touch = UNKNOWN

    def _learn(self, subset: int, y: Floats) -> None:
        """Add a frame to the reference."""
        n = self._n_learnt[subset] + 1
        self._n_learnt[subset] = n
        change = y - self._reference[subset]
        self._reference[subset] += change / n
        if min(self._n_learnt) >= LEARNT:
            self._n_learnt = []
            self._noise = np.full(1, 1 / LEARNT)
            self._below = self.test.windows()
