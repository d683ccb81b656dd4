"""The work on the vectors of a frame in compiled loops, in the order of `HadamardRows`."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.numerics.compiled import ready
from sparseskin.nodes.numerics.kernels import skin_filter, skin_predict, skin_step

from .gates import CLEARLY, QUIET, STANDS_OUT, TILE, WINDOW, Gates, Tiles
from .rows import HadamardRows, Rows
from .tuning import SkinTuning
from .vectors import FrameVectors


class CompiledVectors(FrameVectors):
    """The same as `FrameVectors` but for rounding; the rows are compiled ones, too."""

    def __init__(
        self, rows: Rows, tiles: Tiles, gates: Gates, places: Indices, tuning: SkinTuning
    ) -> None:
        super().__init__(rows, tiles, gates, places, tuning)
        ready(skin_predict, skin_filter, skin_step)
        assert isinstance(rows, HadamardRows)
        t, n = tuning, rows.n
        self._order = rows.groups, rows.scale
        self._next = self._neighbours.reshape(4, n).astype(np.uint32)
        self._slopes, self._rows_of_slopes = np.zeros((2, 2, n), dtype=np.float32)
        of_filter = t.significant, t.prior, t.doubt, t.recall_memory, t.recall_ridge
        self._of_filter = np.array([0.0] * 4 + [*of_filter, 0.0])
        stands_out = tiles.strictness * np.array(STANDS_OUT)
        of_step = t.least_tau, t.most_alpha, t.damping, gates.error_0[0]
        self._of_step = np.array([0.0, 0.0, *of_step, QUIET, *stands_out, CLEARLY, 0.0])
        self._scaled = np.zeros(n + 1, dtype=np.float32)

        def transposed(matrix: Floats) -> Floats:
            return np.ascontiguousarray(matrix.T)

        self._weights = (
            *(transposed(gates.filters), transposed(gates.hidden), gates.hidden_0),
            *(transposed(gates.gates), gates.gates_0, transposed(gates.synthesis), gates.error[0]),
        )
        k, h = len(gates.filters), len(gates.hidden_0)
        widths = (WINDOW * WINDOW, k, 2 * k, h, k + 1, TILE * TILE)
        self._scratch = [
            *(np.zeros((tiles.most, width), dtype=np.float32) for width in widths),
            np.zeros((tiles.most, TILE * TILE), dtype=np.float32),
            np.zeros(tiles.most, dtype=np.float32),
            np.zeros(tiles.most, dtype=np.intp),
        ]

    def predict(self, values: Floats, noise: float) -> None:
        self.predicted, self.innovation = np.empty_like(self.x), np.empty_like(values)
        skin_predict(
            *(self.x, self._whole, values, self._rows.read, self._next, *self._order),
            *(np.array([self._t.ridge, self._t.motion, noise]), self._slopes),
            *(self._rows_of_slopes, self.predicted, self._moved, self.innovation),
        )
        self.z = self.predicted.copy()

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

    def step(self, shift: int, floor: float) -> tuple[Floats, float, float]:
        x = np.empty_like(self.z)
        self._of_step[:2] = self.variance_of_read, floor
        error2 = skin_step(
            *(self.z, x, self._target, self._variance, self._rows.read, self.off_target),
            *(*self._order, self._scaled, *self._tiles.tables(shift), *self._weights),
            *(self._of_step, *self._scratch),
        )
        return x, error2, float(self._of_step[-1])
