"""Detection of faulty measurements: rows of Phi that read 0, a constant or garbage."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.messages.quantised import step_of
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi, is_sbhe
from sparseskin.nodes.numerics.arrays import TINY, Floats, Indices, Mask, shared

#: Least participation ratio of rows that can be compared, and rows that are probed for it.
LEAST_MIXED, N_PROBED = 8.0, 8
#: CUSUM of the squared residual of a row in units of its peers: a frame adds at most `LARGEST`,
#: less `ALLOWED`; it starts at `ODD`; a row is faulty from `ENOUGH` on.
LARGEST, ALLOWED, ENOUGH, ODD = 36.0, 9.0, 150.0, 16.0
#: Frames between two full comparisons, unless a row asks for one.
EVERY = 10
#: Frames without change after which a row is constant, on a skin whose noise changes at least
#: `LIVELY` of the rows from frame to frame; rate of that mean.
CONSTANT, LIVELY, LIVELY_RATE = 20, 0.75, 0.05
#: Frames in which a faulty row must agree with its peers to be used again; doubled after each
#: relapse, up to a limit.
HEALED, MOST_HEALED = 100, 100_000
#: Largest mean squared residual of a healed row, in that of its peers; rate of the mean.
AGREES, AGREES_RATE = 4.0, 0.05
#: Largest part of the rows that may be faulty; with more, something else is wrong.
MOST = 0.25
#: Step of the quantiser, in deviations of a frame's noise, beyond which rows may be constant.
FINE = 0.25
#: Peers that a block needs for a judgement by a single frame.
ENOUGH_PEERS = 6
#: Share of the largest |Phi 1| beyond which a bias shows in a row. The sum of a block of 32 beside
#: blocks of 256 has 0.35, and a bias of clipped noise is 3 deviations of its own noise. Derived.
HEAVY = 0.25
#: Median of the square of a standard normal number.
MEDIAN_SQUARE = 0.455
#: Squared innovation of a measurement, in the mean of its block, that only a fault reaches.
#: Derived: the signs of rows are random, so that 8 deviations occur in one of 10^15 measurements.
OUTLYING = 64.0


class Subset:
    """What does not change of the rows of a Phi.

    Attributes
    ----------
    comparable : bool
        True if rows can be compared: not if each reads a single taxel.
    ones : ndarray of float32, shape (m,)
        Phi 1.
    heavy, light : ndarray of intp, of bool, shape (m,)
        Rows that a bias shows in; all others.
    block, starts : ndarray of intp, shape (m,), (n_blocks,)
        Block of each row, and the first row of each block.
    n_light : ndarray of float32, shape (n_blocks,)
        Number of the light rows of each block, 1 if there is none.
    bound : ndarray of float32, shape (m,)
        Largest squared innovation of a row, in the mean of its block, without a fault.
    like : float
        Part of the energy of any taxel's press that a change common to all rows may explain.
    offset_like : ndarray of intp
        Taxels whose press together looks like a change common to all rows: one of each block.
    """

    def __init__(self, phi: Phi) -> None:
        self.comparable = mixed_taxels(phi) >= LEAST_MIXED
        self.ones = shared(phi.forward(np.ones(phi.n, dtype=np.float32)))
        size = np.abs(self.ones)
        heavy = size > HEAVY * size.max()
        self.heavy: Indices = np.flatnonzero(heavy)
        self.light: Mask = shared(~heavy)
        kept, self.starts, block = np.unique(blocks_of(phi), return_index=True, return_inverse=True)
        self.block = shared(block)
        n_light = np.add.reduceat(self.light.astype(np.float32), self.starts)
        self.n_light: Floats = np.maximum(n_light, 1)
        self.bound = np.full(phi.m, 2 * phi.n, dtype=np.float32)
        if is_sbhe(phi):  # all rows but the sums of blocks have random signs
            sizes = np.array(phi.sizes, dtype=np.float32)[kept][self.block]
            self.bound = np.where(heavy, 2 * sizes, np.float32(OUTLYING))
        sums = phi.adjoint(np.ones(phi.m, dtype=np.float32))
        self.like = phi.n / phi.m**2 * float(np.square(sums).max())
        self.offset_like: Indices = np.flatnonzero(sums > 0.9 * sums.max())


class RowWatch:
    """Finds rows of one Phi whose measurements are 0, constant or garbage, and those healed.

    Each reconstructed frame leaves a residual y - Phi x. A row is judged by its squared residual
    relative to that of its peers, the rows that sum the same taxels with other signs: where a
    contact is reconstructed badly, all of them are off alike. A ratio above 16, which a working row
    has in one frame of ten thousand, starts a CUSUM: each frame adds the ratio, at most 36, less 9;
    it is never below 0. A row that reads garbage reaches 150 within 8 frames.

    The full comparison is made in every tenth frame, wherever a residual exceeds the bound of the
    last one, and in each frame while there is evidence against a row.

    On a skin with noise a row whose value stays the same for 20 frames is faulty, too, also where
    nothing touches the skin and a row that reads 0 does not show. An error of all rows along Phi 1,
    the bias of readings clipped at 0, is no fault. So sums of blocks are compared with each other,
    and that of an only block, which nothing contradicts, is judged by being constant alone.

    Parameters
    ----------
    phi : Phi

    Attributes
    ----------
    rows : Subset
        What does not change of them.
    left_out : ndarray of bool, shape (m,)
        Rows that are faulty now.
    n_out : int
        Their number.
    swamped : bool
        True if so many rows disagree that no more of them are excluded.

    Notes
    -----
    Source: Page, "Continuous inspection schemes", Biometrika 41, 1954, for the CUSUM.
    """

    def __init__(self, phi: Phi) -> None:
        m, self.rows = phi.m, Subset(phi)
        self._ones, self._heavy = self.rows.ones, self.rows.heavy
        self._starts, self._block = self.rows.starts, self.rows.block
        self._heavy_ones = self._ones[self._heavy]
        self._heavy_ones2, self._heavy_size = np.square(self._heavy_ones), np.abs(self._heavy_ones)
        self._last, self._change, self._evidence, self._oddity = np.zeros((4, m), dtype=np.float32)
        self._residual, self._before, self._left, self._bound = np.zeros((4, m), dtype=np.float32)
        self._changed_at, self._agreed = np.zeros((2, m), dtype=np.int32)
        self._coarse = self._suspects = False
        self._to_heal = np.full(m, HEALED, dtype=np.int32)
        self._n_frames = self._n_constant = self._all_changed_at = self.n_out = 0
        self._lively = 0.0
        self.left_out: Mask = np.zeros(m, dtype=np.bool_)
        self.swamped = False
        self._count_peers()

    def update(self, y: Floats, residual: Floats) -> bool:
        """Process measurements as received, and what they exceed Phi times the frame by; float32
        (m,), kept, not copied. Return True if `left_out` has changed.
        """
        if not self.rows.comparable:
            return False
        self._n_frames += 1
        look = self._glance(y, residual)
        if self._n_frames == 1:
            return False  # no change from frame to frame is known yet
        due = self._n_frames % EVERY == 0 or self._suspects or look
        return due and self._look(y)

    def _glance(self, y: Floats, residual: Floats) -> bool:
        """Note residuals and changes; True if a row asks for a full comparison."""
        self._before, self._residual = self._residual, residual
        self._change, self._last = y - self._last, y
        n_changed = np.count_nonzero(self._change)
        all_changed = self._coarse or n_changed == y.size  # as in most frames, for which it is fast
        if all_changed:
            self._all_changed_at = self._n_frames
        else:
            self._changed_at[self._change != 0] = self._n_frames
        rate = max(LIVELY_RATE, 1 / self._n_frames)
        self._lively += rate * (n_changed / y.size - self._lively)
        self._n_constant = 0 if all_changed else int(np.count_nonzero(self._constant()))
        return bool(self._n_constant or np.count_nonzero(np.square(residual) > self._bound))

    def _look(self, y: Floats) -> bool:
        """Compare all rows with their peers; return True if `left_out` has changed."""
        # A solver that fits the noise leaves less than that, and small errors would seem large.
        noise2 = _middle(np.square(self._change)) / MEDIAN_SQUARE / 2
        step = step_of(y)
        self._coarse = step > FINE * math.sqrt(noise2)
        # A force below a step is read as 0 or as a step, in turn.
        noise2 += step * step / 4
        evidence, odd = self._evidence, self._oddness(noise2)
        if self._suspects or np.count_nonzero(odd > ODD):  # else it is 0, and stays so
            evidence[:] = np.where((evidence > 0) | (odd > ODD), evidence + odd - ALLOWED, 0)
            np.clip(evidence, 0, 2 * ENOUGH, out=evidence)
        if not evidence.any() and not self._n_constant and not self.n_out:
            self._suspects = self.swamped = False
            return False
        faulty = (evidence >= ENOUGH) | self._constant()
        changed = self._leave_out(faulty) | self._heal(odd, faulty)
        self._suspects = bool(evidence.any() or self.n_out)
        return changed

    def _oddness(self, noise2: float) -> Floats:
        """Return squared residuals in units of the peers, or of the noise; at most 36."""
        heavy, few = self._heavy, self._few
        # A row subset may hold no row that a bias shows in.
        bias = np.float32(_middle(self._residual[heavy] / self._heavy_ones) if heavy.size else 0)
        self._left = self._residual - bias * self._ones
        squared = np.square(self._left)
        typical = np.float32(max(_middle(squared) / MEDIAN_SQUARE, noise2) + TINY)
        # One huge row must not hide another in its own block.
        peers = np.minimum(squared, LARGEST * typical)
        if self.n_out:
            peers *= self._kept
        peers = np.add.reduceat(peers, self._starts).take(self._block, mode="clip") - peers
        peers *= self._per_peer
        np.maximum(peers, typical, out=peers)
        # The bias differs from block to block, and adds up in sums.
        if heavy.size:
            shares: Floats = np.divide(squared[heavy], self._heavy_ones2, dtype=np.float32)
            per_one = _middle(shares) / MEDIAN_SQUARE
            peers[heavy] = np.maximum(peers[heavy], np.float32(per_one) * self._heavy_ones2)
        np.multiply(peers, ODD, out=self._bound)
        # The quick check of `update` does not subtract the bias of its frame.
        shown = abs(bias) * self._heavy_size
        self._bound[heavy] = np.square(np.sqrt(self._bound[heavy]) + shown)
        # With few peers, a row may be the only one that measures a contact at all. That lasts: in
        # such blocks only the change from frame to frame counts.
        if few.size:
            change = self._residual[few] - self._before[few]
            squared[few] = np.minimum(squared[few], np.square(change, out=change))
        squared /= peers
        return np.minimum(squared, LARGEST, out=squared)

    def _constant(self) -> Mask:
        """Return the rows that are constant, on a skin whose rows are not."""
        changed_at = np.maximum(self._changed_at, self._all_changed_at)
        return (changed_at <= self._n_frames - CONSTANT) & (self._lively >= LIVELY)

    def _leave_out(self, faulty: Mask) -> bool:
        """Exclude faulty rows; return True if there are new ones."""
        new = faulty & ~self.left_out
        self.swamped = False
        if not new.any():
            return False
        if np.count_nonzero(faulty | self.left_out) > MOST * faulty.size:
            self.swamped = True
            return False
        # A faulty row makes its peers look odd: the oddest of a block is excluded first.
        amounts = np.where(new, np.abs(self._left), 0)
        new &= amounts >= 0.5 * np.maximum.reduceat(amounts, self._starts)[self._block]
        self.left_out = self.left_out | new
        self._oddity[new] = LARGEST
        self._agreed[new] = 0
        beside = np.isin(self._block, self._block[new])
        self._evidence[beside & ~new] = 0
        self._count_peers()
        return True

    def _count_peers(self) -> None:
        self.n_out = int(np.count_nonzero(self.left_out))
        self._kept = (~self.left_out).astype(np.float32)
        n_peers = np.add.reduceat(self._kept, self._starts)[self._block] - self._kept
        self._per_peer = 1 / np.maximum(n_peers, 1)
        self._few = np.flatnonzero(n_peers < ENOUGH_PEERS)

    def _heal(self, odd: Floats, faulty: Mask) -> bool:
        """Use rows again that have agreed with their peers for long enough."""
        out = self.left_out
        if not out.any():
            return False
        self._oddity[out] += AGREES_RATE * (odd[out] - self._oddity[out])
        agrees = out & ~faulty & (self._oddity < AGREES)
        self._agreed = np.where(agrees, self._agreed + 1, 0)
        healed = agrees & (self._agreed >= self._to_heal)
        if not healed.any():
            return False
        self._to_heal[healed] = np.minimum(2 * self._to_heal[healed], MOST_HEALED)
        self._evidence[healed] = 0
        self.left_out = out & ~healed
        self._count_peers()
        return True


def _middle(x: Floats) -> float:
    """Return the median, or the upper one of an even number."""
    middle, x = x.size // 2, x.copy()
    x.partition(middle)
    return float(x[middle])


def mixed_taxels(phi: Phi) -> float:
    """Return the smallest participation ratio of some rows: how many taxels each sums, at least."""
    probes = np.linspace(0, phi.m - 1, min(N_PROBED, phi.m)).astype(np.intp)
    least = math.inf
    for row in probes:
        unit = np.zeros(phi.m, dtype=np.float32)
        unit[row] = 1
        weights = np.square(phi.adjoint(unit), dtype=np.float64)
        least = min(least, float(weights.sum() ** 2 / max(np.square(weights).sum(), TINY)))
    return least


def blocks_of(phi: Phi) -> Indices:
    """Return the number of the block of taxels that each row sums; 0 if there are no blocks."""
    if not isinstance(phi, SbhePhi):
        return np.zeros(phi.m, dtype=np.intp)
    ends = np.cumsum(phi.sizes)
    return np.searchsorted(ends, phi.rows, side="right")
