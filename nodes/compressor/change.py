"""Patches whose readings depart from those that were sent last by more than their noise.

The reference of a patch is the mean of readings that were sent while nothing changed. The statistic
is that of `Departures` for readings themselves, which the edge has all of: measurements of N/3 rows
have a root of 3 times the noise of a taxel.
"""

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask

from .departures import Departures, Windows

FALSE_SENDS = 1e-4
"""False sends a frame and patch at rest. Chosen: one in 10,000."""
N_WINDOWS = 4
BLOCK = 2 ** (N_WINDOWS - 1)
"""Readings are compared in windows of 1, 2, 4 and 8 frames; as many join the reference at once.
Chosen."""
SENT = 32
CYCLES = 8
"""Frames, and cycles of the rows, that are sent at least once something has changed. Chosen: the
solver finds weak contacts in the mean of so many."""
LEARNT = 4
"""Sent blocks whose number of frames a reference has at most. Chosen: the noise of 128 frames adds
1/128 to the variance of a reading."""
FIRST_BLOCKS = 2
"""Blocks that are sent first. Chosen: no contact begins in the first three cycles of rows."""


class ChangeWatch:
    """Finds the patches whose frames have to be sent.

    A patch that changes is sent for a block of frames at least, until the two halves of a block
    agree; that block is the reference of the frames that follow. These are compared with it, and
    each `BLOCK` of them joins the reference while they agree.

    Parameters
    ----------
    n_patches : int
        Number of patches.
    skin : SkinState
        Skin and noise of all of them; it states noise.
    cycle : int
        Number of frames that together read all rows of the measurement matrix.

    Attributes
    ----------
    sending : ndarray of bool, shape (n_patches,)
        True for each patch whose next frame is sent, whatever it reads.
    """

    def __init__(self, n_patches: int, skin: SkinState, cycle: int = 1) -> None:
        self.length = max(SENT, CYCLES * cycle)
        self._departures = Departures(
            skin, FALSE_SENDS / self.length, n_windows=N_WINDOWS
        )
        n_scores = self._departures.pyramid.n
        self._windows = Windows(n_patches, n_scores, N_WINDOWS)
        self.sending = np.ones(n_patches, dtype=np.bool_)
        #: Blocks that are still to be sent, the present one too.
        self._blocks = np.full(n_patches, FIRST_BLOCKS)

        shape = n_patches, skin.n_rows, skin.n_cols
        #: Mean readings, and number of frames that they are the mean of.
        self._reference = np.zeros(shape, dtype=np.float32)
        self._n = np.full(n_patches, self.length)
        #: Sums of the readings of a block so far, and of its first half; its number of frames.
        self._total = np.zeros(shape, dtype=np.float32)
        self._half_total = np.zeros(shape, dtype=np.float32)
        self._k = np.zeros(n_patches, dtype=np.intp)
        # Until the first block ends, nothing is compared with them.
        self._bounds = self._departures.no_bounds(n_patches)

    def to_send(self, readings: Floats) -> Mask:
        """Look at the next frame: float32 (n_patches, n_rows, n_cols); return True for each patch
        that is to be sent, bool (n_patches,).
        """
        send = self.sending.copy()
        if not send.all():
            departs = self._departs(readings)
            if departs.any():
                send |= departs
                self._begin(departs)

        self._total += readings
        self._k += 1
        is_half = self._k == self.length // 2
        halves = np.flatnonzero(self.sending & is_half)
        if halves.size:
            self._half_total[halves] = self._total[halves]

        length = np.where(self.sending, self.length, BLOCK)
        ends = self._k == length
        # Before any block ends: its end may stop the sending.
        sent = np.flatnonzero(ends & self.sending)
        quiet = np.flatnonzero(ends & ~self.sending)
        for patch in sent.tolist():
            self._end_sent(patch)
        if quiet.size:
            self._join(quiet)
        return send

    def _begin(self, patches: Mask) -> None:
        """Begin to send some patches: a block of each, of which there is no frame yet."""
        self.sending[patches] = True
        self._blocks[patches] = 1
        self._total[patches] = 0.0
        self._k[patches] = 0

    def _departs(self, readings: Floats) -> Mask:
        """True where a patch that is not sent departs from its reference."""
        difference = readings - self._reference
        # Variance of the reference, in that of a reading.
        noise = 1 / self._n
        scores = self._departures.scores(difference)
        departs = self._windows.alarms(scores, self._bounds.scores, noise)

        energy = self._departures.energy(difference, self._bounds)
        departs |= energy > self._bounds.energy * (1 + noise)
        departs &= ~self.sending
        return departs

    def _end_sent(self, patch: int) -> None:
        """End a block that was sent: it is the reference, if its halves agree."""
        length = self.length
        half = length // 2
        mean = self._total[patch] / length
        early = self._half_total[patch] / half
        late_total = self._total[patch] - self._half_total[patch]
        late = late_total / (length - half)
        self._blocks[patch] -= 1
        self._total[patch] = 0.0
        self._k[patch] = 0
        if self._blocks[patch] > 0:
            return

        # Also where the halves disagree: noise depends on the forces, which have changed.
        bounds = self._departures.bounds(mean[np.newaxis])
        self._bounds.put(patch, bounds)

        # The difference of the means of two halves has 4 / length of the variance of a reading.
        difference = (late - early)[np.newaxis]
        scores = self._departures.scores(difference)
        deviation = np.sqrt(4 / length, dtype=np.float32)
        limits = bounds.scores[:, -1] * deviation
        if (np.abs(scores) <= limits).all():
            self._reference[patch] = mean
            self._n[patch] = length
            self._windows.restart(slice(patch, patch + 1))
            self.sending[patch] = False

    def _join(self, patches: Indices) -> None:
        """Let a block of some patches that was not sent join the reference."""
        n = self._n[patches]
        means = self._total[patches] / np.float32(BLOCK)
        self._total[patches] = 0.0
        self._k[patches] = 0

        # A reference that has learnt enough stays: it would follow a slow change.
        joins = n < LEARNT * self.length
        joining = patches[joins]
        share = BLOCK / (n[joins] + BLOCK)
        share_32 = share.astype(np.float32)[:, np.newaxis, np.newaxis]
        correction = means[joins] - self._reference[joining]
        self._reference[joining] += share_32 * correction
        self._n[joining] += BLOCK
