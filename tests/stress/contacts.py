"""False alarms of the watch for idle patches, and contacts that it misses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import RATIO, ROTATING, row_subsets, rows_and_m
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.batch.idle import REFERENCE, REFRESH, IdleWatch
from sparseskin.nodes.sensor.noise import NoiseModel

FRAMES = (1, 5, 15, 63)
"""Frames after the begin of a contact at which the missed ones are counted; the last one is just
before the solve that comes anyway."""


@dataclass(frozen=True)
class Missed:
    """Shares of contacts not noticed after the first `FRAMES`.

    `sigmas` is the force of each touched taxel in standard deviations of an untouched one, `side`
    the side of the touched square in taxels.
    """

    side: int
    sigmas: float
    shares: tuple[float, ...]


class Watched:
    """Patches under constant forces and noise, watched frame by frame."""

    def __init__(self, n_patches: int, side: int, truth: Floats, seed: int = 0) -> None:
        skin = Skin(side, side, PAPER_F_MAX_N, pitch_m=0.005)
        self.noise = NoiseModel.for_range(skin.f_max)
        state = SkinState(
            stamp_ns=0,
            patch="skin",
            **vars(skin),
            source="study",
            seed=seed,
            rate_hz=0.0,
            has_truth=True,
            sigma_mid=self.noise.sigma_mid,
            sigma_end=self.noise.sigma_end,
        )
        rows, m = rows_and_m("sbhe", skin.n_taxels, rows=ROTATING, m=None, ratio=RATIO)
        self._phis = row_subsets(make_phi("sbhe", n=skin.n_taxels, m=m, seed=seed), rows)
        self.watch = IdleWatch(n_patches, state, self._phis)
        self._rng = np.random.default_rng(seed)
        self._n_patches, self._k = n_patches, 0
        for patch in range(n_patches):
            self.watch.solved(patch, truth)
        for _ in range((REFERENCE + 1) * len(self._phis)):
            self.frame(truth)

    def frame(self, truth: Floats) -> Mask:
        """True for each patch that would be solved, in the next frame under these forces."""
        phi = self._phis[self._k % len(self._phis)]
        self._k += 1
        y = [
            phi.forward(self.noise.apply(truth, self._rng).reshape(-1))
            for _ in range(self._n_patches)
        ]
        return self.watch.to_solve(phi.fingerprint, np.stack(y))


def false_alarms(truth: Floats, n_patches: int, n_frames: int) -> float:
    """Share of frames that are solved though nothing changes, without those solved anyway."""
    watched = Watched(n_patches, len(truth), truth)
    solved = [watched.frame(truth) for _ in range(REFRESH * (n_frames // REFRESH))]
    return float(np.mean(solved)) - 1 / REFRESH


def missed(side: int, contact: int, sigmas: float, n_patches: int, seed: int = 0) -> Missed:
    """Share of contacts on an untouched patch that no frame has noticed.

    `contact` is the side of the touched square in taxels, at a random place; solves that come
    anyway are not counted.
    """
    untouched = np.zeros((side, side), np.float32)
    watched = Watched(n_patches, side, untouched, seed)
    truth = untouched.copy()
    row, col = np.random.default_rng(seed).integers(0, side - contact + 1, 2)
    truth[row : row + contact, col : col + contact] = sigmas * watched.noise.sigma_end
    open_ = np.ones(n_patches, np.bool_)
    shares: dict[int, float] = {}
    watched.watch.never_due()
    for k in range(1, max(FRAMES) + 1):
        open_ &= ~watched.frame(truth)
        shares[k] = float(open_.mean())
    return Missed(contact, sigmas, tuple(shares[k] for k in FRAMES))
