"""The method of the default solver as one compiled function of a frame, for `sbhe`."""

from __future__ import annotations

import threading
from dataclasses import asdict
from functools import lru_cache
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.phi.base import UNREAD
from sparseskin.nodes.numerics.arrays import Floats, shared
from sparseskin.nodes.numerics.compiled import ready
from sparseskin.nodes.numerics.kernels import CONSTANTS, NUMBERS, skin_frame
from sparseskin.nodes.sensor.noise import CLIPPED, CLIPPED_BELOW, NoiseModel

from .estimator import DUST, INVISIBLE, REPEATED, RESOLUTION, SAME
from .formula import LEAST, STRICT
from .gates import CLEARLY, MARGIN, QUIET, SHIFTS, STANDS_OUT, TILE, WINDOW, Gates, Tiles
from .rows import CompiledRows
from .tuning import SkinTuning
from .vectors import NEGLIGIBLE, UNKNOWN, neighbours_of


class CompiledEstimator:
    """The same as `SkinEstimator` of one patch but for rounding; it needs numba.

    Parameters
    ----------
    rows : CompiledRows
    tiles, gates, tuning
        As of `FrameVectors`.
    """

    def __init__(
        self, rows: CompiledRows, tiles: Tiles, gates: Gates | None, tuning: SkinTuning
    ) -> None:
        ready(skin_frame)
        self._rows = rows
        self.noise_sd = 0.0
        self.noise_model: NoiseModel | None = None
        self._stated: tuple[float, NoiseModel | None] | None = None
        n, weights = rows.n, gates or Gates.zero()
        of_modules = {
            "resolution": RESOLUTION,
            "repeated": REPEATED,
            "same": SAME,
            "invisible": INVISIBLE,
            "dust": DUST,
            "negligible": NEGLIGIBLE,
            "unknown": UNKNOWN,
            "unread": UNREAD,
            "quiet": QUIET,
            "single": tiles.strictness * STANDS_OUT[0],
            "by_3": tiles.strictness * STANDS_OUT[1],
            "by_6": tiles.strictness * STANDS_OUT[2],
            "whole": tiles.strictness * STANDS_OUT[3],
            "clearly": CLEARLY,
            "strict": STRICT,
            "least": LEAST,
            "error_0": weights.error_0[0],
            "clipped": CLIPPED,
            "clipped_below": CLIPPED_BELOW,
        }
        constants = asdict(tuning) | of_modules
        self._constants = np.array(
            [tuple(constants[name] for name in CONSTANTS.names or ())], CONSTANTS
        )
        self._numbers = np.zeros(1, NUMBERS)
        self._vectors, self._recall = np.zeros((11, n), dtype=np.float32), np.zeros(3)
        neighbours, *others = _tables(tiles)
        self._of_skin = neighbours, rows.groups, rows.scale, *others
        of_hidden = weights.filters, weights.hidden, weights.hidden_0
        of_gates = weights.gates, weights.gates_0, weights.synthesis, weights.error[0]
        self._weights = [np.ascontiguousarray(array) for array in (*of_hidden, *of_gates)]
        self._gated = gates is not None
        of_net = len(weights.filters), len(weights.hidden_0)
        self._sizes = tuning.averaged, n, rows.read.size, tiles.canvas.size, tiles.most, *of_net
        #: By row subset: the last measurements and innovation; Phi 1.
        self._last: dict[str, tuple[Floats, Floats]] = {}
        self._known: set[str] = set()
        self.forget()

    def forget(self) -> None:
        """As in `SkinEstimator`."""
        self._vectors[:], self._recall[:], self._numbers[:] = 0, 0, 0
        self._vectors[4] = UNKNOWN
        self._numbers["trust"] = self._numbers["trusted"] = 1
        self._known.clear()
        self._stated = None
        self.n_shifts = 0

    def start_from(self, x: Floats) -> None:
        """As in `SkinEstimator`."""
        self._vectors[0], self._vectors[1] = x, self._rows.forward(x)

    def begin(self, subset: str, y: Floats) -> None:
        """As in `SkinEstimator`; `finish` does all the work."""
        rows = self._rows
        if subset not in self._last:
            ones = rows.forward(np.ones(rows.n, dtype=np.float32))[rows.read]
            self._last[subset] = np.zeros((2, y.size), dtype=np.float32), shared(ones)
        self._subset, self._read = subset, (rows.values(y), rows.read)

    def finish(self, n: int, n_formula: int) -> Floats:
        """As in `SkinEstimator`."""
        if (stated := (self.noise_sd, self.noise_model)) != self._stated:
            self._note_noise(*stated)
        last, ones = self._last[self._subset]
        frame = *self._read, ones, last, self._subset in self._known
        self._known.add(self._subset)
        forces = np.empty(self._rows.n, dtype=np.float32)
        steps = self.n_shifts, n_formula if n else 0, n, self._gated
        of_read, estimates, *scratch = _scratch(self._sizes)
        estimates = estimates[: max(1, n)]
        skin_frame(
            *(*frame, self._vectors, of_read, self._recall, *self._of_skin, *steps),
            *(*self._weights, estimates, *scratch, forces, self._numbers, self._constants),
        )
        self.n_shifts = (self.n_shifts + (n_formula + n if n else 0)) % len(SHIFTS)
        return forces

    def _note_noise(self, noise_sd: float, model: NoiseModel | None) -> None:
        """Note the noise that the skin states."""
        self._stated, numbers = (noise_sd, model), self._numbers[0]
        numbers["noise_sd"] = noise_sd
        numbers["f_max"] = 0.0 if model is None else model.f_max
        if model is not None:
            numbers["sigma_mid"], numbers["sigma_end"] = model.sigma_mid, model.sigma_end
            numbers["clips"], numbers["of_touched"] = model.clips, model.of_touched

    @property
    def noise(self) -> float:
        """As of `SkinEstimator`; so are the others."""
        return float(self._numbers["noise"][0])

    @property
    def bias(self) -> float:
        return float(self._numbers["bias"][0])

    @property
    def stated_error(self) -> float:
        return float(self._numbers["stated_error"][0])

    @property
    def trusted(self) -> bool:
        return bool(self._numbers["trusted"][0])


@lru_cache(maxsize=16)
def _tables(tiles: Tiles) -> tuple[Any, ...]:
    """Neighbours; canvas and cells of the taxels; cells of a row; of each shift first cells of the
    windows with a taxel, their shares and number.
    """
    n_shifts, most, n = len(SHIFTS), tiles.most, tiles.cells.size
    begins, shares = np.zeros((n_shifts, most), np.uint32), np.zeros((n_shifts, most), np.float32)
    counts, places = np.zeros(n_shifts, np.int64), np.arange(tiles.canvas.size)
    for k, share in enumerate(tiles.shares):
        kept, first = share > 0, tiles.cut(places.reshape(tiles.canvas.shape), k)[:, 0]
        counts[k] = count = np.count_nonzero(kept)
        begins[k, :count], shares[k, :count] = first[kept], share[kept]
    neighbours = neighbours_of(tiles.places, n).reshape(4, n).astype(np.uint32)
    canvas, width = tiles.canvas.reshape(-1).astype(np.uint32), tiles.canvas.shape[1]
    row, col = np.divmod(tiles.cells, tiles.shape[1])
    cells = ((row + MARGIN) * width + col + MARGIN).astype(np.uint32)
    return neighbours, canvas, cells, width, begins, shares, counts


_OF_THREAD = threading.local()


def _scratch(sizes: tuple[int, ...]) -> list[Any]:
    """Estimates and scratch of a frame, shared by the solvers of a thread: they stay in its cache.

    Sizes: estimates that are averaged; taxels; rows read; cells of the canvas; tiles; filters;
    hidden units.
    """
    if getattr(_OF_THREAD, "sizes", None) != sizes:
        averaged, n, m, cells, most, k, h = sizes
        widths = WINDOW * WINDOW, k, 2 * k, h, k + 1, TILE * TILE
        shapes = [(3, m), (max(1, averaged), n), (4, n), n + 1, cells, cells]
        shapes += [(most, width) for width in widths]
        shapes += [(85, most), (65, most), most]
        _OF_THREAD.arrays = [np.zeros(shape, dtype=np.float32) for shape in shapes]
        _OF_THREAD.arrays.append(np.zeros(most, dtype=np.intp))
        _OF_THREAD.sizes = sizes
    found: list[Any] = _OF_THREAD.arrays
    return found
