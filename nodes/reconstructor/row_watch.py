"""Watches the rows of measurements: which of them have nothing to do with the skin."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.compressor.calls import Floats, Indices
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.compressor.sbhe import SbhePhi

Bools = npt.NDArray[np.bool_]

#: A row that is one of many sums over the same taxels is told from them; one that reads a single
#: taxel is that taxel.
LEAST_MIXED, N_PROBED = 8.0, 8
#: What a frame adds to the evidence against a row: its squared residual over that of its peers,
#: no more than `LARGEST`, less `ALLOWED`; the row is false from `ENOUGH` on. Evidence begins with
#: `ODD` at least.
LARGEST, ALLOWED, ENOUGH, ODD = 36.0, 9.0, 150.0, 16.0
#: Frames between two close looks, where no row asks for one.
EVERY = 10
#: Frames without any change after which a row reads a constant, on a skin whose noise changes
#: at least `LIVELY` of the rows from frame to frame.
CONSTANT, LIVELY, LIVELY_RATE = 20, 0.75, 0.05
#: Frames in which a false row has to agree with its peers to be believed again; twice as many
#: each time that it was false once more.
HEALED, MOST_HEALED = 100, 100_000
#: Mean of the squared residual, in that of the peers, that a healed row has at most.
AGREES, AGREES_RATE = 4.0, 0.05
#: With more false rows than this part of all, something else is wrong.
MOST = 0.25
#: Part of a frame's noise that a step of few bits may be for constant rows to be told.
FINE = 0.25
ENOUGH_PEERS = 6
MEDIAN_SQUARE = 0.455
TINY = 1e-30


class RowWatch:
    """Finds rows of one Phi that read 0, a constant or garbage, and those that work again.

    Each restored frame leaves a residual y - Phi x. A row is judged by its residual against that
    of its peers, the rows that sum the same taxels with other signs: where a contact is restored
    badly all of them are off alike. Once the squared ratio has passed 16, which a row that works
    does in one frame of ten thousand, it adds up to the evidence against that row: cut off at 36,
    less 9, never below 0. A row that reads garbage reaches 150 within 8 frames.

    Most frames get a glance: whether any residual has passed what the last close look allows. A
    close look compares all peers; there is one wherever a row has, each tenth frame, and in
    each frame while there is evidence against a row.

    On a skin with noise a row whose value stays the same for 20 frames is false, too, also where
    nobody touches the skin and a row that reads 0 does not show.

    What all rows miss along Phi 1, the bias of readings that are cut off at 0, is no fault.

    Parameters
    ----------
    phi : Phi

    Attributes
    ----------
    watches : bool
        Whether rows can be told apart at all: not where each reads a single taxel.
    left_out : ndarray of bool, shape (m,)
        Rows that are false now.
    swamped : bool
        Whether so many rows disagree that no more of them are left out.

    Notes
    -----
    Source: Page, "Continuous inspection schemes", Biometrika 41, 1954, for evidence that adds up.
    """

    def __init__(self, phi: Phi) -> None:
        m = phi.m
        self._phi = phi
        self.watches = mixed_taxels(phi) >= LEAST_MIXED
        ones = phi.forward(np.ones(phi.n, dtype=np.float32))
        self._ones = ones
        # The rows that a bias shows in.
        self._heavy: Indices = np.flatnonzero(np.abs(ones) > 0.5 * np.abs(ones).max())
        self._heavy_ones = ones[self._heavy]
        _, self._starts, self._block = np.unique(
            _blocks(phi), return_index=True, return_inverse=True
        )
        self._last, self._before, self._evidence, self._misfit = np.zeros((4, m), dtype=np.float32)
        self._residual, self._left = np.zeros((2, m), dtype=np.float32)
        self._squared, self._bound = np.zeros((2, m), dtype=np.float32)
        self._last_but_one = np.zeros(m, dtype=np.float32)
        self._changed_at, self._agreed = np.zeros((2, m), dtype=np.int32)
        self._loud = np.zeros(m, dtype=np.bool_)
        self._coarse = self._suspects = False
        self._to_heal = np.full(m, HEALED, dtype=np.int32)
        self._n_frames = 0
        self._lively = 0.0
        self.left_out: Bools = np.zeros(m, dtype=np.bool_)
        self.swamped = False
        self._count_peers()

    def cleaned(self, y: Floats, last: Floats | None) -> Floats:
        """Return measurements with what the last frame says in place of false rows.

        Parameters
        ----------
        y : ndarray of float32, shape (m,)
            Measurements, newtons; not modified.
        last : ndarray of float32, shape (n,), optional
            Forces of the existing taxels in the last frame; None: 0.
        """
        if not self.left_out.any():
            return y
        expected = np.zeros_like(y) if last is None else self._phi.forward(last)
        cleaned: Floats = np.where(self.left_out, expected, y).astype(np.float32)
        return cleaned

    def update(self, y: Floats, fitted: Floats) -> bool:
        """Take in a restored frame.

        Parameters
        ----------
        y : ndarray of float32, shape (m,)
            Measurements as they came, newtons.
        fitted : ndarray of float32, shape (m,)
            Phi times the restored frame.

        Returns
        -------
        bool
            Whether `left_out` has changed.
        """
        if not self.watches:
            return False
        self._n_frames += 1
        self._residual, self._before = self._before, self._residual
        np.subtract(y, fitted, out=self._residual)
        np.square(self._residual, out=self._squared)
        np.greater(self._squared, self._bound, out=self._loud)
        self._note_changes(y)
        if self._n_frames == 1:
            return False  # what changes from frame to frame is not known yet
        due = self._n_frames % EVERY == 0 or self._suspects or self._loud.any()
        return bool(due or self._constant().any()) and self._look(y)

    def _look(self, y: Floats) -> bool:
        """Compare all rows with their peers; whether `left_out` has changed."""
        # A solver that fits the noise leaves less than it, and small errors would be large.
        noise2 = _typical(self._last - self._last_but_one) / 2
        step = y.step if isinstance(y, Quantised) else 0.0
        self._coarse = step > FINE * math.sqrt(noise2)
        # A force below a step is read as 0 or as a step, again and again.
        noise2 += step * step / 4
        odd = self._oddness(noise2)
        evidence = self._evidence
        odd_enough = (evidence > 0) | (odd > ODD)
        evidence += odd
        evidence -= ALLOWED
        evidence *= odd_enough
        np.clip(evidence, 0, 2 * ENOUGH, out=evidence)
        false = (evidence >= ENOUGH) | self._constant()
        changed = self._leave_out(false) | self._heal(odd, false)
        self._suspects = bool(evidence.any() or self.left_out.any())
        return changed

    def _oddness(self, noise2: float) -> Floats:
        """Squared residuals over what the peers have, and over the noise; no more than 36."""
        heavy, few = self._heavy, self._few
        bias = np.float32(_middle(self._residual[heavy] / self._heavy_ones))
        self._left = self._residual - bias * self._ones
        squared = np.square(self._left)
        typical = np.float32(max(_middle(squared) / MEDIAN_SQUARE, noise2) + TINY)
        # One huge row must not hide another in its own block.
        peers = np.minimum(squared, LARGEST * typical)
        peers *= self._kept
        peers = np.add.reduceat(peers, self._starts)[self._block] - peers
        peers *= self._per_peer
        np.maximum(peers, typical, out=peers)
        # What is left of the bias differs from block to block.
        peers[heavy] = np.maximum(peers[heavy], _middle(squared[heavy]) / MEDIAN_SQUARE)
        np.multiply(peers, ODD, out=self._bound)
        # A glance does not know the bias of its frame.
        shown = abs(bias) * np.abs(self._heavy_ones)
        self._bound[heavy] = np.square(np.sqrt(self._bound[heavy]) + shown)
        # A row may be the only one of few that feels a contact at all. That lasts; of such blocks
        # only what changes from frame to frame counts.
        news = self._residual[few] - self._before[few]
        squared[few] = np.minimum(squared[few], np.square(news, out=news))
        squared /= peers
        return np.minimum(squared, LARGEST, out=squared)

    def _note_changes(self, y: Floats) -> None:
        """Note which rows read something else than in the frame before."""
        changed = y != self._last
        self._last, self._last_but_one = self._last_but_one, self._last
        np.copyto(self._last, y)
        rate = max(LIVELY_RATE, 1 / self._n_frames)
        self._lively += rate * (np.count_nonzero(changed) / changed.size - self._lively)
        if self._coarse:
            self._changed_at.fill(self._n_frames)
        else:
            np.copyto(self._changed_at, self._n_frames, where=changed)

    def _constant(self) -> Bools:
        """Which rows have read the same for long, on a skin that does not."""
        return (self._changed_at <= self._n_frames - CONSTANT) & (self._lively >= LIVELY)

    def _leave_out(self, false: Bools) -> bool:
        """Believe false rows no longer; whether there are new ones."""
        new = false & ~self.left_out
        self.swamped = False
        if not new.any():
            return False
        if np.count_nonzero(false | self.left_out) > MOST * false.size:
            self.swamped = True
            return False
        # What a false row did to the frame looks odd in its peers: the oddest of a block is first.
        amounts = np.where(new, np.abs(self._left), 0)
        new &= amounts >= 0.5 * np.maximum.reduceat(amounts, self._starts)[self._block]
        self.left_out |= new
        self._misfit[new] = LARGEST
        self._agreed[new] = 0
        beside = np.isin(self._block, self._block[new])
        self._evidence[beside & ~new] = 0
        self._count_peers()
        return True

    def _count_peers(self) -> None:
        self._kept = (~self.left_out).astype(np.float32)
        n_peers = np.add.reduceat(self._kept, self._starts)[self._block] - self._kept
        self._per_peer = 1 / np.maximum(n_peers, 1)
        self._few = np.flatnonzero(n_peers < ENOUGH_PEERS)

    def _heal(self, odd: Floats, false: Bools) -> bool:
        """Believe rows again that have agreed with their peers for long enough."""
        out = self.left_out
        if not out.any():
            return False
        self._misfit[out] += AGREES_RATE * (odd[out] - self._misfit[out])
        agrees = out & ~false & (self._misfit < AGREES)
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
    """The median, or the next larger one of an even number."""
    middle = x.size // 2
    return float(np.partition(x, middle)[middle])


def _typical(x: Floats) -> float:
    """Variance of normal numbers some of which are others: from the median of their squares."""
    return _middle(np.square(x)) / MEDIAN_SQUARE


def mixed_taxels(phi: Phi) -> float:
    """How many taxels a row sums, at least: the smallest participation ratio of some rows."""
    probes = np.linspace(0, phi.m - 1, min(N_PROBED, phi.m)).astype(np.intp)
    least = math.inf
    for row in probes:
        unit = np.zeros(phi.m, dtype=np.float32)
        unit[row] = 1
        weights = np.square(phi.adjoint(unit), dtype=np.float64)
        least = min(least, float(weights.sum() ** 2 / max(np.square(weights).sum(), TINY)))
    return least


def _blocks(phi: Phi) -> Indices:
    """Number of the block of taxels that each row sums; all one where there are no blocks."""
    if not isinstance(phi, SbhePhi):
        return np.zeros(phi.m, dtype=np.intp)
    ends = np.cumsum(phi.hadamard.sizes)
    return np.searchsorted(ends, phi.rows, side="right")
