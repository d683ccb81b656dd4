"""Patches whose measurements have changed by no more than their noise explains: not solved.

Measurements y of a row subset are compared with a reference, the mean of n earlier ones of the same
subset while nothing changed. If nothing has changed, d = y - reference is noise: of a patch under
the forces f, sigma(f)^2 a taxel by the skin's noise model (0.3408 sigma_end^2 of an untouched one,
whose readings are clipped at 0), times 1 + 1 / n. Three tests have to pass:

- chi-square: sum d^2 over its variance, against M degrees of freedom, widened for taxels whose
  variances differ;
- tiles: the projection of d on the measurements of a force on each of 8 x 8 tiles of the patch,
  against a normal distribution, the largest of all tiles;
- slow: the exponential mean of these projections over the last 15 frames or so.

Their false alarms are `FALSE_ALARMS` a frame in all, if the noise is as stated. An alarm costs one
solve; two in a row end the idle state. A patch is idle once the reference of each subset is a mean
of `REFERENCE` frames, and is solved all the same every `REFRESH` frames, so that no contact is
missed for longer. Skins that state no noise are always solved.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask
from sparseskin.nodes.sensor.noise import CLIPPED, NoiseModel

FALSE_ALARMS = 1e-3
"""False alarms a frame and patch, chosen: each costs a solve."""
REFERENCE = 4
"""Frames of each row subset in a reference, chosen: its noise adds an eighth to a difference's."""
REFRESH = 64
"""Frames after which an idle patch is solved, chosen: 1.6 % of the solves."""
TILES = 8
"""Tiles along a side of the patch, chosen: a fingertip on 64 x 64 taxels fills one."""
SLOW = 1 / 8
"""Weight of a frame in the exponential mean."""


class IdleWatch:
    """Finds the patches of a batch that need no solve.

    Parameters
    ----------
    n_patches : int
        Number of patches.
    skin : SkinState
        Skin and noise model of all of them.
    phis : sequence of Phi
        One a row subset.
    """

    def __init__(self, n_patches: int, skin: SkinState, phis: Sequence[Phi]) -> None:
        self._exists = skin.skin.exists
        self._noise = NoiseModel(skin.f_max, skin.sigma_mid, skin.sigma_end)
        self._subsets = {phi.fingerprint: k for k, phi in enumerate(phis)}
        self._tile_of, n_tiles = _tiles(self._exists)
        self._sizes = np.bincount(self._tile_of, minlength=n_tiles)
        # What each matrix measures of a force on each tile, with a length of 1; and the variance of
        # a measurement, in that of the noise of a taxel.
        self._projections = []
        self._energy = []
        for phi in phis:
            columns = [
                phi.forward((self._tile_of == k).astype(np.float32))
                for k in range(n_tiles)
            ]
            matrix = np.stack(columns, axis=1)
            norms = np.linalg.norm(matrix, axis=0)
            energy = np.sum(norms**2) / self._sizes.sum() * phi.n / phi.m
            self._energy.append(float(energy))
            lengths = np.where(norms > 0, norms, 1).astype(np.float32)
            self._projections.append(matrix / lengths)

        # A third of the false alarms each: the first test has one tail, the others have two.
        m = phis[0].m
        self._ratio = min(1.0, m / phis[0].n)
        quantile = NormalDist().inv_cdf
        self._z_total = quantile(1 - FALSE_ALARMS / 3)
        self._z_tile = quantile(1 - FALSE_ALARMS / 6 / n_tiles)

        # References by row subset and patch, and the number of frames in each.
        self._reference = np.zeros((len(phis), n_patches, m), np.float32)
        self._n = np.zeros((len(phis), n_patches), np.intp)
        self._slow = np.zeros((n_patches, n_tiles))
        self._n_slow = np.zeros(n_patches, np.intp)
        self._forces: list[Floats | None] = [None] * n_patches
        self._known = np.zeros(n_patches, np.bool_)
        self._mean = np.ones(n_patches)
        self._spread = np.ones(n_patches)
        self._local = np.ones((n_patches, n_tiles))
        self._struck = np.zeros(n_patches, np.bool_)
        # Patches that are idle together are solved again in different frames.
        self._age = np.arange(n_patches) % REFRESH
        self.idle = np.zeros(n_patches, np.bool_)

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
        if subset is None or not self._noise.sigma_end:
            return np.ones(len(y), np.bool_)
        n = self._n[subset]
        compared = n > 0
        alarm = np.zeros(len(y), np.bool_)
        if compared.any():
            alarm = compared & self._alarms(subset, y)
        # One alarm of an idle patch is solved; with a second one in a row it is no longer idle.
        ends = alarm & (self._struck | ~self.idle)
        self._struck = alarm & ~ends
        self._restart(ends)
        learns = ~self.idle & ~self._struck
        if learns.any():
            n[learns] += 1
            change = y[learns] - self._reference[subset, learns]
            self._reference[subset, learns] += change / n[learns][:, None]
        self._age += 1
        due = self._age >= REFRESH
        self._age[due] = 0
        solve: Mask = ~self.idle | self._struck | due
        # The frame that completes the reference is solved, the next one is not: its variances are
        # those of the newest forces.
        complete = learns & (self._n >= REFERENCE).all(axis=0)
        self._known[complete] = False
        self.idle |= complete
        return solve

    def solved(self, patch: int, forces: Floats) -> None:
        """Note the forces of a patch, by number, float32, shape (n_rows, n_cols)."""
        self._forces[patch] = forces

    def _restart(self, which: Mask) -> None:
        """Begin new references for some patches."""
        self._n[:, which] = 0
        self._reference[:, which] = 0.0
        self._n_slow[which] = 0
        self._slow[which] = 0.0
        self.idle[which] = self._known[which] = False

    def _alarms(self, subset: int, y: Floats) -> Mask:
        """True where a test finds a change from the reference of a row subset."""
        for patch in np.flatnonzero(~self._known):
            self._learn_variances(int(patch))
        energy = self._energy[subset]
        change = y - self._reference[subset]
        # The noise of a reference adds to that of a frame.
        widened = 1 + 1 / np.maximum(self._n[subset], 1)
        squares = np.einsum("pm,pm->p", change, change)
        differs = self._differs_in_all(squares / (energy * self._mean * widened))

        # Of M of N rows, a projection has the noise of its tile in the part M / N, else of all.
        z = change @ self._projections[subset]
        of_tiles = self._ratio * self._local.T + (1 - self._ratio) * self._mean
        variances = energy * of_tiles.T
        largest = (z * z / (variances * widened[:, None])).max(axis=1)
        slow = self._slow_change(subset, z, variances)
        limit = self._z_tile**2
        differs |= (largest > limit) | (slow > limit)
        return differs

    def _differs_in_all(self, chi2: Doubles) -> Mask:
        """True where the sum of squares of M measurements, in their variance, is too large."""
        m = self._reference.shape[2]
        # The cube root of a chi-square is nearly normal: Wilson and Hilferty, PNAS 17 (1931).
        dof = m / self._spread
        normal = (np.cbrt(chi2 / m) - (1 - 2 / (9 * dof))) / np.sqrt(2 / (9 * dof))
        differs: Mask = normal > self._z_total
        return differs

    def _slow_change(self, subset: int, z: Doubles, variances: Doubles) -> Doubles:
        """Largest squared exponential mean of the projections of each patch, in its variance."""
        compared = self._n[subset] > 0
        self._n_slow += compared
        n_slow = np.maximum(self._n_slow, 1)
        weight = compared * np.maximum(SLOW, 1 / n_slow)
        self._slow += weight[:, None] * (z - self._slow)

        # The noise of the references is the same in all frames: no mean over them makes it less.
        n_references = np.maximum(self._n[subset], 1) * len(self._subsets)
        share = np.maximum(SLOW / (2 - SLOW), 1 / n_slow) + 1 / n_references
        largest: Doubles = (self._slow**2 / (variances * share[:, None])).max(axis=1)
        return largest

    def _learn_variances(self, patch: int) -> None:
        """Variances of the taxels under the last forces of a patch: mean, spread, of tiles."""
        frame = self._forces[patch]
        if frame is None:
            return
        # Readings near 0 are clipped there, which leaves less noise.
        forces = frame[self._exists]
        sigma_end = self._noise.sigma_end
        unclipped = np.square(self._noise.sigma(forces), dtype=np.float64)
        sigma2: Doubles = np.where(
            forces > sigma_end, unclipped, CLIPPED * sigma_end**2
        )
        mean = float(sigma2.mean())
        excess = float(np.mean(sigma2**2)) / mean**2 - 1
        self._mean[patch] = mean
        self._spread[patch] = 1 + self._ratio * excess
        tiles = np.bincount(self._tile_of, weights=sigma2, minlength=len(self._sizes))
        self._local[patch] = tiles / np.maximum(self._sizes, 1)
        self._known[patch] = True


def _tiles(exists: Mask) -> tuple[np.ndarray[tuple[int], np.dtype[np.intp]], int]:
    """Number of the tile of each existing taxel, and the number of tiles."""
    n_rows, n_cols = exists.shape
    rows, cols = np.nonzero(exists)
    high = min(TILES, n_rows)
    wide = min(TILES, n_cols)
    tile_of_taxel = rows * high // n_rows * wide + cols * wide // n_cols
    return tile_of_taxel, high * wide
