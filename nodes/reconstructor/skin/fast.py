"""The solver `skin` in compiled loops: a frame in five calls, a smooth round in two."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.numerics import kernels
from sparseskin.nodes.numerics.arrays import TINY, Floats, Indices, Mask
from sparseskin.nodes.numerics.compiled import MAX_PLACES, ready
from sparseskin.nodes.reconstructor.bases.shifted_haar import SHIFTS, ShiftedHaar
from sparseskin.nodes.reconstructor.solvers.projection import CompiledProjection

from .noise_level import NoiseLevel
from .prediction import Prediction
from .smooth import REACH, SmoothModel
from .sums import Read, Tested
from .tuning import TUNING, SkinTuning

LINE = 16
"""Vectors are a line of the cache, 64 bytes, more than a power of two apart: else their elements
compete for the same places of the cache."""


class CompiledFrame:
    """The vectors of `SkinSolver`, and what it does with them, for "sbhe".

    Vectors of taxels and of rows have n elements, and follow each other in one array.

    Parameters
    ----------
    projection : CompiledProjection
    haar : ShiftedHaar
    place_of_cell : ndarray of intp, shape (n_cells,)
        Place in a vector of each cell; n where no taxel exists.
    neighbours : ndarray of intp, shape (2, 2, n)
        As `neighbours_of` returns them.
    shifts : list of int
        Numbers of the shifts of the iterations, in their order.
    tuning : SkinTuning

    Attributes
    ----------
    x, x_and_zero : ndarray of float32, shapes (n,) and (n + 1,)
        The estimate, newtons, and with a 0 behind it.
    z, total, y, correction, whole, fitted, known, values : ndarray of float32, shape (n,)
        As in `SkinSolver`, `Prediction` and `RowMemory`.
    """

    def __init__(
        self,
        projection: CompiledProjection,
        haar: ShiftedHaar,
        place_of_cell: Indices,
        neighbours: Indices,
        shifts: list[int],
        tuning: SkinTuning,
    ) -> None:
        n = projection.n_rows
        self._t, self._n, self._projection = tuning, n, projection
        self._work = np.zeros((kernels.N_WORK, spread(n + 1)), dtype=np.float32)
        self.x_and_zero = self._work[kernels.X, : n + 1]
        vectors = self._work[:, :n]
        self.x, self.z, self.total = (vectors[k] for k in (kernels.X, kernels.Z, kernels.TOTAL))
        self.y, self.correction = vectors[kernels.Y], vectors[kernels.CORRECTION]
        self.whole, self.fitted = vectors[kernels.WHOLE], vectors[kernels.FITTED]
        self.known, self.values = vectors[kernels.KNOWN], vectors[kernels.VALUES]
        self._canvas = np.zeros(haar.size, dtype=np.float32)
        small = haar.size < MAX_PLACES and n < MAX_PLACES
        self._iterate = kernels.skin_iterate if small else kernels.skin_iterate_large
        ready(kernels.skin_read, kernels.skin_aim, kernels.skin_test, kernels.skin_end)
        ready(self._iterate)
        tables = [haar.tables(shift) for shift in range(len(SHIFTS))]
        self._to_canvas, self._from_canvas = (
            np.array(gathers, dtype=np.uint16 if small else np.uint32)
            for gathers in zip(*tables, strict=True)
        )
        self._shifts = np.array(shifts, dtype=np.int64)
        self._cells = place_of_cell.astype(np.uint32)
        self._around = neighbours.reshape(4, n).astype(np.uint32)
        self._tables: dict[int, Floats] = {}
        self._root_m = 1.0

    def use(self, subset: int, kept: Floats, ones: Floats) -> None:
        """Expect measurements of the row subset of this number, which the projection now is of.

        `kept` and `ones`, float32 (n,), are those of `HeldOut` and `ClipBias`.
        """
        projection, t = self._projection, self._t
        if subset not in self._tables:
            rows = projection.measured, projection.read, kept, ones, projection.scale
            self._tables[subset] = np.array(rows, dtype=np.float32)
            m = projection.places.size
            self._root_m, freedom = math.sqrt(m), max(0, m - 3) / 3
            self._limits = np.array(
                (
                    *(t.motion_still * m, t.motion_significant, freedom),
                    *(t.failed_part, t.failed_noise * m),
                )
            )
        self._table, self._places = self._tables[subset], projection.places

    def read(
        self,
        y: Floats,
        noise: NoiseLevel,
        prediction: Prediction,
        bias: float,
        remembers: bool,
        most2: float,
    ) -> Read:
        """As `SkinSolver._read`; if the square of y is not below most2, nothing but that is done.

        y, float32 (m,), is checked in no other way.
        """
        past = noise.past
        *sums, moved, failed = kernels.skin_read(
            *(self._work, self._table, y, past.values, self._places, self._projection.groups),
            *(self._around, self._limits, most2, bias, noise.s2),
            *(past.begun, prediction.knows_whole, remembers),
        )
        found = Read(*sums)
        if found.power < most2:
            prediction.moved, prediction.failed = moved > 0, failed > 0
            prediction.knows_whole = False
        return found

    def aim(self, gain: float, counted: float | None) -> None:
        """As `SkinSolver._aim`."""
        weight = 0.0 if counted is None else counted
        kernels.skin_aim(self._work, self._table, gain, weight, counted is not None)

    def iterate(
        self, first: int, count: int, n_summed: int, threshold: float, least: float
    ) -> None:
        """Do `count` iterations from shift `first` on; the last `n_summed` are summed.

        The threshold is in RMS of r, at least `least`, newtons.
        """
        self._iterate(
            self._work,
            self._canvas,
            self._projection.groups,
            *(self._to_canvas, self._from_canvas, self._shifts[first : first + count]),
            n_summed,
            threshold / self._root_m,
            least,
            self._t.momentum,
        )

    def test(self, factor: float) -> Tested:
        """Set x to `factor` times the total unless that is 0, and W x; return the sums of x."""
        return Tested(*kernels.skin_test(self._work, self._table, self._projection.groups, factor))

    def end(self, fitted: Floats, bias: float) -> Floats:
        """Return the forces of all cells, newtons, with the bias added back.

        `fitted`, float32 (n,), is W x.
        """
        forces = np.empty(self._cells.size, dtype=np.float32)
        kernels.skin_end(self._work, fitted, self._cells, bias, forces)
        return forces


class CompiledSmoothModel(SmoothModel):
    """As `SmoothModel` by conjugate gradients, for "sbhe".

    Gaussians are filters of the image, as far as they are not below the rounding of float32. Zeros
    surround the image, and follow each row, as many as a filter reaches.
    """

    gradient_s = 0.0

    def __init__(
        self,
        projection: CompiledProjection,
        taxels: Indices,
        mask: Mask,
        tuning: SkinTuning = TUNING,
    ) -> None:
        ready(kernels.filter_image, kernels.smooth_descend, kernels.smooth_deviation)
        self._dealt = projection
        super().__init__(projection, taxels, mask, tuning=tuning)

    def _make_filters(self, mask: Mask) -> None:
        lengths, n = self._t.lengths, self._taxels.size
        self._filters = filters(mask.shape, lengths)
        self._blur_filters = filters(mask.shape, (self._t.blur,))
        reach = np.concatenate((self._filters[1], self._blur_filters[1]))
        stride = mask.shape[1] + int(reach[1::2].max())
        first, size = int(reach[::2].max()) * stride + int(reach.max()), mask.shape[0] * stride
        self._layout = np.array((first, size, stride), dtype=np.int64)
        self._images = np.zeros((3, 2 * first + size), dtype=np.float32)
        rows, cols = np.divmod(self._taxels, mask.shape[1])
        places = first + rows * stride + cols
        self._places = places.astype(np.uint32)
        self._work = np.zeros((kernels.N_SMOOTH, spread(n)), dtype=np.float32)
        image, half, total = self._images
        image[places] = 1
        kernels.filter_image(image, half, total, self._layout, *self._blur_filters)
        self._work[kernels.NEIGHBOURS, :n] = total[places] + np.float32(TINY)

    def _deviation_of(self, x: Floats) -> Floats:
        kernels.smooth_deviation(
            *(self._work, self._images, self._places, self._layout, *self._blur_filters),
            *(x, self._t.deviation_floor),
        )
        return self._work[kernels.DEVIATION, : x.size]

    def _descend(self, mean: float, variance: Floats) -> Floats:
        n, t = self._taxels.size, self._t
        self._work[kernels.DEVIATION, :n] = self._deviation
        self._work[kernels.ROWS_KNOWN, :n] = self._known
        self._work[kernels.ROWS_USED, :n] = self._used
        self._work[kernels.VARIANCE, :n] = variance
        kernels.smooth_descend(
            *(self._work, self._images, self._places, self._dealt.scale, self._dealt.groups),
            *(self._layout, *self._filters, self._gradients),
            *(mean, t.model_error * mean, t.precise),
        )
        return self._work[kernels.FIELD, :n]


def filters(shape: tuple[int, ...], lengths: tuple[float, ...]) -> tuple[Floats, Indices]:
    """Return the weights of Gaussians of each length, down and right, and their reach.

    Weights are float32 (2 k, r + 1), those right divided by k, the number of lengths. The reach,
    int64 (2 k,), is even: how many weights follow the first.
    """
    reach = np.array([min(int(REACH * one), side - 1) for one in lengths for side in shape])
    reach += reach % 2
    distance = np.arange(reach.max() + 1) / np.repeat(lengths, 2)[:, None]
    weights = np.exp(-0.5 * distance**2)
    weights[1::2] /= len(lengths)
    return weights.astype(np.float32), reach.astype(np.int64)


def spread(n: int) -> int:
    """Return the distance of vectors of n elements: a line more than a power of two, as `LINE`."""
    padded = -(-n // LINE) * LINE
    return padded + (LINE if padded // LINE % 2 == 0 else 0)
