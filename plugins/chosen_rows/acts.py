"""Adaptive compressive tactile subsampling: single taxels, chosen anew in each frame.

`ActsSearch` chooses the taxels of a frame from those already read, on a coarse lattice first and
then around forces; `ActsPhi` is the measurement matrix of the choice, which travels with the
measurements as a bit a taxel.

Source: Slepyan, Li, Aug, Sankar, Tran, Thakor, "Adaptive Compressive Tactile Subsampling",
arXiv 2410.13847.
"""

from collections.abc import Callable
from types import MappingProxyType

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.base import BLOCK, Code, fingerprint_of
from sparseskin.nodes.compressor.phi.identity import SubsamplePhi
from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.numerics.arrays import AnyArray, Floats, Indices, Mask
from sparseskin.nodes.touch import touch_level

SIGMAS = 4.0
"""Standard deviations of an untouched taxel's noise above which a reading is a force. Chosen: of
1600 untouched taxels 0.05 read more."""
COARSE_PART = 0.25
"""Largest part of the readings that the first, evenly spaced lattice takes. Chosen."""
N_ROUNDS = 8
"""Least number of rounds of reading, each decided from those before it. Chosen."""

Read = Callable[[Indices], Floats]


class ActsPhi(SubsamplePhi):
    """Phi = Q of this frame: m single taxels, set by `choose` for each frame; before the first
    choice those of `SubsamplePhi`. The fingerprint is of n and m alone: the choice has to travel
    with the measurements.
    """

    kind = "acts"
    # The rows are chosen anew in each frame.
    can_rotate = False
    choice = "places"
    solvers = MappingProxyType(
        {"interpolation": f"{__package__}.interpolation:InterpolationSolver"}
    )

    def __init__(self, n: int, m: int, seed: int, block: int = BLOCK) -> None:
        super().__init__(n, m, seed, block)
        self.fingerprint = fingerprint_of(self.kind, n, m, 1)
        self._exists: Mask = np.ones((1, n), dtype=np.bool_)
        self._search: ActsSearch | None = None
        self.state_noise(0.0, PAPER_F_MAX_N)

    def _lay_out(self, exists: Mask) -> None:
        self._exists = exists.copy()
        self._search = None

    def state_noise(self, sigma_end: float, f_max: float, clipped: bool = True) -> None:
        self._threshold = touch_level(sigma_end, f_max, SIGMAS)
        self._search = None

    def measure(self, x: Floats) -> tuple[Floats, Code]:
        # At the edge alone: a host follows what was chosen.
        if self._search is None:
            self._search = ActsSearch(self._exists, self.m, self._threshold)
        self.choose(self._search.places(x.take))
        return self.forward(x), packed_places(self.rows, self.n)

    def follow(self, code: Code) -> None:
        self.choose(np.flatnonzero(np.unpackbits(code)))

    @property
    def most_code_bytes(self) -> int:
        return -(-self.n // 8)

    def choose(self, taxels: Indices) -> None:
        """Set the taxels of a frame; PhiError unless they are m ascending indices in 0..n-1."""
        if taxels.shape != (self.m,):
            raise PhiError(
                f"acts: {taxels.size} taxels are read; expected m = {self.m}"
            )
        # Codes come over the wire: another program may have made them.
        is_ascending = (taxels[1:] > taxels[:-1]).all()
        if taxels[0] < 0 or taxels[-1] >= self.n or not is_ascending:
            raise PhiError(f"acts: the taxels are not ascending within 0..{self.n - 1}")
        self.rows = taxels


def packed_places(taxels: Indices, n: int) -> Code:
    """One bit a taxel, the highest first, set for those of the indices: uint8 (ceil(n / 8),)."""
    is_read = np.zeros(n, dtype=np.bool_)
    is_read[taxels] = True
    return np.packbits(is_read)


class ActsSearch:
    """Chooses and reads m taxels of a frame, each from the readings before it.

    First a coarse lattice of every s-th taxel both ways. Then, in rounds, taxels of lattices of
    s / 2, s / 4 ... 1 next to ones that bear a force. Their order is that of the score (highest -
    lowest reading around) x step, descending: an interpolation is worst between different
    readings far apart. Where nothing is left to refine, the lattice is made finer everywhere,
    which may find more to refine. A frame's choice depends on that frame alone.

    `exists`, bool (n_rows, n_cols), is True where a taxel exists; readings above `threshold`, as of
    `touch_level` with `SIGMAS`, are forces. Raises PhiError if m is not in 1..n.

    Source: the binary sampling of Slepyan et al.; the score is this project's own.
    """

    def __init__(self, exists: Mask, m: int, threshold: float) -> None:
        n = int(np.count_nonzero(exists))
        if not 1 <= m <= n:
            raise PhiError(
                f"acts: m = {m} is not allowed; allowed: 1..{n} (n = {n} taxels)"
            )
        self.m = m
        self._threshold = threshold

        self._taxel_of_cell = np.full(exists.shape, -1, dtype=np.intp)
        self._taxel_of_cell[exists] = np.arange(n)
        self._numbers = np.arange(exists.size).reshape(exists.shape)
        self._steps = _steps(exists, m)
        self._offset = self._steps[0] // 2

        # -inf where no taxel is, or none was read yet.
        self._readings = np.empty(exists.shape, dtype=np.float32)
        self._unread = np.empty(exists.shape, dtype=np.bool_)
        self._score = np.empty(exists.shape, dtype=np.float32)
        self._exists = exists.copy()

    def places(self, read: Read) -> Indices:
        """Read a frame by `read`, of indices of taxels; return its m taxels, intp, ascending."""
        self._readings.fill(-np.inf)
        np.copyto(self._unread, self._exists)

        # Single forces lie between the taxels of the first lattice: rounds look for them.
        n_left = self.m - self._read(self._lattice(self._steps[0]), self.m, read)
        while n_left:
            n_most = min(n_left, max(1, self.m // N_ROUNDS))
            cells = self._to_refine(n_most)
            # Where no force is left to refine, others are looked for.
            if not cells.size:
                cells = self._to_explore(n_most)
            n_left -= self._read(cells, n_left, read)

        return np.sort(self._taxel_of_cell[self._exists & ~self._unread])

    def _read(self, cells: Indices, n_most: int, read: Read) -> int:
        """Read the first `n_most` of the cells; return their number."""
        cells = cells[:n_most]
        self._unread.reshape(-1)[cells] = False
        self._readings.reshape(-1)[cells] = read(self._taxel_of_cell.reshape(-1)[cells])
        return int(cells.size)

    def _lattice(self, step: int) -> Indices:
        """Return the cells of a lattice that were not read yet."""
        numbers = self._part(self._numbers, step)
        is_unread = self._part(self._unread, step)
        cells: Indices = numbers[is_unread]
        return cells

    def _part(self, grid: AnyArray, step: int) -> AnyArray:
        """Return the cells of a lattice, also those that were read."""
        offset = self._offset % step
        return grid[offset::step, offset::step]

    def _to_refine(self, n_most: int) -> Indices:
        """Return unread cells next to a force, the highest score first."""
        # A cell of several lattices has the highest of their scores.
        self._score.fill(-1)
        for step in self._steps[1:]:
            highest, lowest = _around(self._part(self._readings, step))
            is_unread = self._part(self._unread, step)
            next_to_force = is_unread & (highest > self._threshold)
            score = self._part(self._score, step)
            step_score = (highest - lowest) * np.float32(step)
            np.maximum(score, step_score, out=score, where=next_to_force)

        # The highest first; of equal ones, in the order of the cells.
        cells = np.flatnonzero(self._score >= 0)
        scores = self._score.reshape(-1)[cells]
        order = np.argsort(-scores, kind="stable")
        return cells[order[:n_most]]

    def _to_explore(self, n_most: int) -> Indices:
        """Return cells of the coarsest lattice that was not read whole, spread evenly over it."""
        for step in self._steps:
            cells = self._lattice(step)
            if cells.size:
                n = min(n_most, cells.size)
                spread = np.linspace(0, cells.size - 1, n).astype(np.intp)
                return cells[spread]
        raise AssertionError("every taxel is read, but fewer than m")


def _steps(exists: Mask, m: int) -> list[int]:
    """Return the steps of the lattices, from the coarsest to 1, each half of the one before."""
    # As coarse as needed: the first lattice leaves most readings for what it finds.
    step = 1
    while step < max(exists.shape):
        offset = step // 2
        n_cells = np.count_nonzero(exists[offset::step, offset::step])
        if n_cells <= max(1, COARSE_PART * m):
            break
        step *= 2
    return [step >> k for k in range(step.bit_length())]


def _around(known: Floats) -> tuple[Floats, Floats]:
    """Highest and lowest reading of each cell and its neighbours; -inf and inf if none was read."""
    # SciPy has such filters, and takes too long to import at an edge.
    high = np.pad(known, 1, constant_values=-np.inf)
    low = np.where(high == -np.inf, np.float32(np.inf), high)
    for axis in (0, 1):
        high = sliding_window_view(high, 3, axis=axis).max(axis=-1)
        low = sliding_window_view(low, 3, axis=axis).min(axis=-1)
    return high, low
