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
    false_alarms : float
        Probability of an alarm a frame and patch where nothing has changed, all tests together.
    """

    def __init__(
        self,
        n_patches: int,
        skin: SkinState,
        phis: Sequence[Phi],
        false_alarms: float = FALSE_ALARMS,
    ) -> None:
        self._exists = skin.skin.exists
        self._noise = (
            NoiseModel(skin.f_max, skin.sigma_mid, skin.sigma_end)
            if skin.sigma_end
            else None
        )
        self._subsets = {phi.fingerprint: k for k, phi in enumerate(phis)}
        self._tile_of, n_tiles = _tiles(self._exists)
        self._sizes = np.bincount(self._tile_of, minlength=n_tiles)
        self._projections = []
        self._energy = []
        for phi in phis:
            columns = [
                phi.forward((self._tile_of == k).astype(np.float32))
                for k in range(n_tiles)
            ]
            matrix = np.stack(columns, axis=1)
            norms = np.linalg.norm(matrix, axis=0)
            self._energy.append(
                float(np.sum(norms**2) / self._sizes.sum() * phi.n / phi.m)
            )
            self._projections.append(
                matrix / np.where(norms > 0, norms, 1).astype(np.float32)
            )
        self._ratio = min(1.0, phis[0].m / phis[0].n)
        one = NormalDist().inv_cdf
        self._z_total = one(1 - false_alarms / 3)
        self._z_tile = one(1 - false_alarms / 6 / n_tiles)
        s = len(phis)
        m = phis[0].m
        self._reference = np.zeros((s, n_patches, m), np.float32)
        self._n = np.zeros((s, n_patches), np.intp)
        self._slow = np.zeros((n_patches, n_tiles))
        self._n_slow = np.zeros(n_patches, np.intp)
        self._forces: list[Floats | None] = [None] * n_patches
        self._known = np.zeros(n_patches, np.bool_)
        self._mean = np.ones(n_patches)
        self._spread = np.ones(n_patches)
        self._local = np.ones((n_patches, n_tiles))
        self._struck = np.zeros(n_patches, np.bool_)
        self._age = (
            np.arange(n_patches) % REFRESH
        )  # they are solved in different frames
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
        if subset is None or self._noise is None:
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
            step = (y[learns] - self._reference[subset, learns]) / (n[learns] + 1)[
                :, None
            ]
            self._reference[subset, learns] += step
            n[learns] += 1
        self._age += 1
        due = self._age >= REFRESH
        self._age[due] = 0
        solve: Mask = ~self.idle | self._struck | due
        # The frame that completes the reference is solved, the next one is not.
        complete = learns & (self._n >= REFERENCE).all(axis=0)
        self._known[complete] = False  # the variances are those of the newest forces
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
        n = np.maximum(self._n[subset], 1)
        energy = self._energy[subset]
        d = y - self._reference[subset]
        m = d.shape[1]
        widened = 1 + 1 / n
        total = np.einsum("pm,pm->p", d, d) / (energy * self._mean * widened)
        # The cube root of a chi-square is nearly normal: Wilson and Hilferty, PNAS 17 (1931).
        dof = m / self._spread
        normal = (np.cbrt(total / m) - (1 - 2 / (9 * dof))) / np.sqrt(2 / (9 * dof))
        z = d @ self._projections[subset]
        variances = (
            energy * (self._ratio * self._local.T + (1 - self._ratio) * self._mean).T
        )
        largest = (z * z / (variances * widened[:, None])).max(axis=1)
        compared = self._n[subset] > 0
        self._n_slow += compared
        n_slow = np.maximum(self._n_slow, 1)
        weight = compared * np.maximum(SLOW, 1 / n_slow)
        self._slow += weight[:, None] * (z - self._slow)
        # Of the exponential mean and of the references, which is the same in all of its frames.
        share = np.maximum(SLOW / (2 - SLOW), 1 / n_slow) + 1 / (n * len(self._subsets))
        slow = (self._slow**2 / (variances * share[:, None])).max(axis=1)
        limit = self._z_tile**2
        differs: Mask = (normal > self._z_total) | (largest > limit) | (slow > limit)
        return differs

    def _learn_variances(self, patch: int) -> None:
        """Variances of the taxels under the last forces of a patch: mean, spread, of tiles."""
        forces = self._forces[patch]
        if forces is None or self._noise is None:
            return
        f = forces[self._exists]
        end = self._noise.sigma_end
        sigma2: Doubles = np.where(
            f > end, np.square(self._noise.sigma(f), dtype=np.float64), CLIPPED * end**2
        )
        self._mean[patch] = mean = float(sigma2.mean())
        self._spread[patch] = 1 + self._ratio * (
            float(np.mean(sigma2**2)) / mean**2 - 1
        )
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
