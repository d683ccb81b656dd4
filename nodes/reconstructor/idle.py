"""Patches whose measurements have changed by no more than their noise explains: not solved.

Measurements y of a row subset are compared with a reference, the mean of n earlier ones of the same
subset while nothing changed, by the statistic of `Departures`: squares of which at most `MOST` have
one side, in windows of 1, 2, 4 ... 16 frames, and the energy. Their variances follow from the last
forces.

Their false alarms are `FALSE_ALARMS` a frame in all, if the noise is as stated. An alarm costs one
solve; two in a row end the idle state. A patch is idle once the reference of each subset is a mean
of `REFERENCE` frames, and is solved all the same every `REFRESH` frames, so that no contact is
missed for longer. A skin has to state its noise.
"""

from collections.abc import Sequence

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.nodes.compressor.departures import Departures, Windows
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats, Mask

FALSE_ALARMS = 1e-3
"""False alarms a frame and patch, chosen: each costs a solve."""
REFERENCE = 4
"""Frames of each row subset in a reference, chosen: its noise adds an eighth to a difference's."""
REFRESH = 64
"""Frames after which an idle patch is solved, chosen: 1.6 % of the solves."""
MOST = 64
"""Most squares of a side, chosen: of 64 x 64 taxels those of 8 x 8, which a fingertip fills."""
N_WINDOWS = 5
"""Windows of 1, 2, 4, 8 and 16 frames, chosen."""


class IdleWatch:
    """Finds the patches of a batch that need no solve.

    Parameters
    ----------
    n_patches : int
        Number of patches.
    skin : SkinState
        Skin and noise of all of them; it states noise.
    phis : sequence of Phi
        One a row subset.
    """

    def __init__(self, n_patches: int, skin: SkinState, phis: Sequence[Phi]) -> None:
        self._departures = Departures(
            skin, FALSE_ALARMS, phis, n_windows=N_WINDOWS, most=MOST
        )
        n_subsets = len(phis)
        n_scores = self._departures.pyramid.n
        self._subsets = {phi.fingerprint: k for k, phi in enumerate(phis)}
        self._windows = Windows(n_patches, n_scores, N_WINDOWS, n_subsets)
        self._bounds = self._departures.no_bounds(n_patches)

        #: Mean measurements, and number of frames that they are the mean of.
        shape = n_subsets, n_patches, phis[0].m
        self._reference = np.zeros(shape, dtype=np.float32)
        self._n = np.zeros((n_subsets, n_patches), dtype=np.intp)
        self._forces: list[Floats | None] = [None] * n_patches
        #: True where the bounds are those of the forces of a patch.
        self._bounded = np.zeros(n_patches, dtype=np.bool_)
        #: True where the last frame of an idle patch was an alarm.
        self._struck = np.zeros(n_patches, dtype=np.bool_)
        # They are solved in different frames.
        self._age = np.arange(n_patches) % REFRESH
        self.idle = np.zeros(n_patches, dtype=np.bool_)

    def to_solve(self, fingerprint: str, y: Floats) -> Mask:
        """Return True for each patch that has to be solved.

        Parameters
        ----------
        fingerprint : str
            Of the Phi of this frame.
        y : ndarray of float32, shape (n_patches, M)
            Measurements of this frame.

        Returns
        -------
        ndarray of bool, shape (n_patches,)
        """
        subset = self._subsets.get(fingerprint)
        if subset is None:
            return np.ones(len(y), np.bool_)
        n = self._n[subset]
        alarm = np.zeros(len(y), np.bool_)
        if n.any():
            alarm = self._alarms(subset, y)

        # One alarm of an idle patch is solved; with a second one in a row it is no longer idle.
        ends = alarm & (self._struck | ~self.idle)
        self._struck = alarm & ~ends
        self._restart(ends)
        learns = ~self.idle & ~self._struck
        if learns.any():
            change = y[learns] - self._reference[subset, learns]
            n[learns] += 1
            n_learnt = n[learns][:, np.newaxis]
            self._reference[subset, learns] += change / n_learnt

        self._age += 1
        due = self._age >= REFRESH
        self._age[due] = 0
        solve = ~self.idle | self._struck | due
        # The frame that completes the reference is solved, the next one is not.
        has_reference = (self._n >= REFERENCE).all(axis=0)
        complete = learns & has_reference
        # The variances are those of the newest forces.
        self._bounded[complete] = False
        self._windows.restart(complete)
        self.idle |= complete
        return solve

    def solved(self, patch: int, forces: Floats) -> None:
        """Note the forces of a patch, by number, float32, shape (n_rows, n_cols)."""
        self._forces[patch] = forces

    def _restart(self, patches: Mask) -> None:
        """Begin new references for some patches."""
        self._n[:, patches] = 0
        self._reference[:, patches] = 0.0
        self._windows.restart(patches)
        self.idle[patches] = False
        self._bounded[patches] = False

    def _alarms(self, subset: int, y: Floats) -> Mask:
        """True where measurements depart from the reference of a row subset."""
        departures = self._departures
        for patch in np.flatnonzero(~self._bounded).tolist():
            forces = self._forces[patch]
            if forces is not None:
                bounds = departures.bounds(forces[np.newaxis])
                self._bounds.put(patch, bounds)
                self._bounded[patch] = True

        n = self._n[subset]
        is_compared = n > 0
        difference = y - self._reference[subset]
        difference[~is_compared] = 0.0
        # Variance of the reference, in that of a frame.
        noise = 1 / np.maximum(n, 1)
        scores = departures.scores(difference, subset)
        alarms = self._windows.alarms(scores, self._bounds.scores, noise)
        energy = departures.energy(difference, self._bounds)
        alarms |= energy > self._bounds.energy * (1 + noise)
        alarms &= is_compared
        return alarms
