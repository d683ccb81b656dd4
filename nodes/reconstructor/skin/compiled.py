"""The work on the vectors of a frame in compiled loops, in the order of `HadamardRows`."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Floats, Indices
from sparseskin.nodes.numerics.compiled import ready
from sparseskin.nodes.numerics.kernels import skin_filter, skin_predict, skin_settle, skin_steps

from .formula import LEAST, STRICT
from .gates import CLEARLY, QUIET, SHIFTS, STANDS_OUT, TILE, WINDOW, Gates, Tiles
from .rows import CompiledRows, Rows
from .tuning import SkinTuning
from .vectors import FrameVectors, Settled, Steps


class CompiledVectors(FrameVectors):
    """The same as `FrameVectors` but for rounding; the rows are compiled ones, too."""

    def __init__(
        self, rows: Rows, tiles: Tiles, gates: Gates | None, places: Indices, tuning: SkinTuning
    ) -> None:
        super().__init__(rows, tiles, gates, places, tuning)
        ready(skin_predict, skin_filter, skin_steps, skin_settle)
        assert isinstance(rows, CompiledRows)
        t, n = tuning, rows.n
        self._order = rows.groups, rows.scale
        self._next = self._neighbours.reshape(4, n).astype(np.uint32)
        self._slopes, self._rows_of_slopes = np.zeros((2, 2, n), dtype=np.float32)
        self._of_predict = np.array([t.ridge, t.motion, 0.0, 0.0, 0.0, 0.0])
        self._of_settle = np.zeros(8)
        of_filter = t.significant, t.prior, t.doubt, t.recall_memory, t.recall_ridge
        self._of_filter = np.array([0.0] * 4 + [*of_filter, 0.0])
        stands_out = tiles.strictness * np.array(STANDS_OUT)
        weights = gates or Gates.zero()
        of_step = t.least_tau, t.most_alpha, t.damping, weights.error_0[0]
        of_tiles = QUIET, *stands_out, CLEARLY, STRICT, LEAST
        self._of_step = np.array([0.0, 0.0, *of_step, *of_tiles, 0.0, 0.0])
        self._scaled = np.zeros(n + 1, dtype=np.float32)
        of_hidden = weights.filters, weights.hidden, weights.hidden_0
        of_gates = weights.gates, weights.gates_0, weights.synthesis, weights.error[0]
        self._weights = [np.ascontiguousarray(array) for array in (*of_hidden, *of_gates)]
        k, h = len(weights.filters), len(weights.hidden_0)
        widths = (WINDOW * WINDOW, k, 2 * k, h, k + 1, TILE * TILE)
        self._scratch = [
            *(np.zeros((tiles.most, width), dtype=np.float32) for width in widths),
            np.zeros((tiles.most, TILE * TILE), dtype=np.float32),
            *(np.zeros((height, tiles.most), dtype=np.float32) for height in (85, 65)),
            np.zeros(tiles.most, dtype=np.float32),
            np.zeros(tiles.most, dtype=np.intp),
        ]

    def predict(self, values: Floats, noise: float) -> None:
        self.predicted, self.innovation = np.empty_like(self.x), np.empty_like(values)
        self._of_predict[2] = noise
        skin_predict(
            *(self.x, self._whole, values, self._rows.read, self._next, *self._order),
            *(self._of_predict, self._slopes, self._rows_of_slopes, self._correction),
            *(self.predicted, self._moved, self.innovation),
        )
        self.z = self.predicted.copy()
        self._compare(*self._of_predict[3:].tolist())

    def filter_rows(
        self, values: Floats, noise: float, signal: float, error2: float, floor: float
    ) -> None:
        self._of_filter[:4] = noise, signal, error2, floor
        self.off_target = np.empty_like(values)
        skin_filter(
            *(values, self.innovation, self._moved, self._whole, self._rows.read),
            *(self._mean, self._noise, self._change, self._target, self._variance),
            *(self.off_target, self._recall, self._of_filter),
        )
        self.variance_of_read = float(self._of_filter[-1])

    def steps(self, first: int, floor: float, n_formula: int, n: int) -> Steps:
        tiles, total = self._tiles, n_formula + n
        assert isinstance(tiles, Tiles)
        for k in range(min(total, len(SHIFTS))):
            tiles.prepare((first + k) % len(SHIFTS))
        estimates = np.empty((min(n, self._t.averaged), self.z.size), dtype=np.float32)
        found = np.empty((total, 2))
        self._of_step[:2] = self.variance_of_read, floor
        skin_steps(
            *(self.z, estimates, self._target, self._variance, self._rows.read, self.off_target),
            *(*self._order, self._scaled, tiles.windows, tiles.back, tiles.share, tiles.counts),
            *(first, n_formula if self._gates else total, found),
            *(*self._weights, self._of_step, *self._scratch),
        )
        errors, residuals = found[n_formula:].T.tolist()
        return Steps(estimates, errors, residuals)

    def settle(
        self,
        estimates: Floats,
        part: float,
        values: Floats,
        ones: Floats,
        bias: float,
        noise_sd: float,
        least: float,
    ) -> Settled:
        forces = np.empty_like(self.x)
        self._of_settle[:4] = part, bias, 2 * noise_sd + math.sqrt(TINY), least
        skin_settle(
            *(estimates, self.predicted, values, ones, self._rows.read, self._moved),
            *(*self._order, self._of_settle, self.x, self._whole, self._correction, forces),
        )
        return Settled(forces, *self._of_settle[4:].tolist())
