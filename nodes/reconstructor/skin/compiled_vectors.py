"""The work on vectors of the default solver in compiled loops, for `sbhe`; it needs numba."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from sparseskin.nodes.numerics import kernels
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.numerics.compiled import entry_point, ready
from sparseskin.nodes.sensor.noise import CLIPPED, CLIPPED_BELOW, NoiseModel

from .formula import LEAST, STRICT
from .gates import QUIET, Gates
from .prediction import Motion, MotionSums
from .row_subset import Comparison, RowSubset
from .rows import CompiledRows
from .standing_out import CLEARLY, deviations_of, scales_of
from .tiles import MARGIN, SHIFTS, Tiles, neighbours_of
from .tuning import SkinTuning
from .vectors import (
    CERTAIN,
    CLEAR_RATIO,
    CONVERGED,
    FORMULA_SHARE,
    N_FORMULA,
    UNKNOWN,
    Blend,
    Filtered,
    Innovation,
    RowVariances,
    Settled,
    StepPlan,
    Steps,
    Vectors,
)


class CompiledVectors(Vectors):
    """The same as `FrameVectors` but for rounding.

    Parameters
    ----------
    rows : CompiledRows
    tiles, gates, tuning
        As of `FrameVectors`.
    """

    def __init__(
        self, rows: CompiledRows, tiles: Tiles, gates: Gates | None, tuning: SkinTuning
    ) -> None:
        self._loops = _loops()
        n = rows.n
        self._rows = rows
        self._transform = kernels.Transform(rows.groups, rows.scale)
        self._maps = _maps(tiles)
        self._neighbours = _neighbours(tiles)
        self._weights = _weights(gates or Gates.zero())
        self._limits = kernels.Limits(scales_of(tiles), CLEARLY, QUIET, STRICT, LEAST)
        self._sizes = ScratchSizes(
            n=n,
            n_cells=tiles.canvas.size,
            n_windows=tiles.most,
            n_filters=self._weights.filters.shape[1],
            n_hidden=len(self._weights.hidden_0),
        )
        self._has_gates = int(gates is not None)
        self._doubt_constants = kernels.DoubtConstants(
            tuning.outlying, CLEAR_RATIO, CERTAIN, float(np.float32(UNKNOWN))
        )
        self._step_constants = _step_constants(tuning)
        self._filter_constants = _filter_constants(tuning)

        vectors = np.zeros((10, n), dtype=np.float32)
        self._estimate = kernels.Estimate(*vectors[:3])
        self._prediction = kernels.Prediction(*vectors[3:5])
        mean, variance, change = vectors[5:8]
        self._filters = kernels.Filters(mean, variance, change, confirmed=np.zeros(4))
        self._targets = kernels.Targets(*vectors[8:])
        self._recall = np.zeros(3)
        self._step_scratch: Scratch | None = None
        self.x = self._estimate.x
        self.x_rows = self._estimate.rows
        self.forget()

    def forget(self) -> None:
        self._recall[:] = 0
        self._filters.confirmed[:] = 0
        self.x[:] = 0
        self.forget_rows()

    def forget_rows(self) -> None:
        self.start_from(self.x)
        self._estimate.correction[:] = 0
        self._filters.mean[:] = self.x_rows
        self._filters.variance[:] = UNKNOWN
        self._filters.change[:] = 0

    def start_from(self, x: Floats) -> None:
        self.x[:] = x
        self.x_rows[:] = self._rows.forward(x)

    def begin(
        self, y: Floats, subset: RowSubset, bias: float, noise: float
    ) -> tuple[Comparison, MotionSums]:
        rows = self._rows
        read = rows.read
        n_read = len(read)
        vectors = np.empty((10, n_read), dtype=np.float32)
        values, innovation, predicted, off_target, residual, doubt, excess = vectors[:7]
        self.innovation = innovation
        self.predicted = predicted
        self.residual = residual
        self.doubt = doubt
        measured = kernels.Measured(
            *(read, values, innovation, subset.innovation),
            *(predicted, subset.predicted),
            *(off_target, residual, doubt, excess, *vectors[7:]),
        )
        self._measured = measured

        slopes = _scratch(self._sizes).slopes
        self._slopes = slopes
        sums = self._loops.begin(
            y,
            kernels.Received(
                *(rows.order, subset.y, subset.ones),
                *(subset.block, subset.n_blocks, subset.faulty),
            ),
            *(bias, noise, self._doubt_constants),
            *(measured, self._estimate, self._filters),
            *(self._neighbours, self._transform, slopes),
        )
        return Comparison._make(sums[:3]), MotionSums._make((*sums[3:], n_read, rows.n))

    def predict(self, motion: Motion) -> Innovation:
        sums = self._loops.predict(
            *(self._estimate, motion, self._slopes),
            *(self._transform, self._measured, self._prediction, self._filters),
            self._filter_constants,
        )
        self._of_steps = self._prediction.x
        return Innovation._make((*sums, len(self.innovation)))

    def filter_rows(self, variances: RowVariances) -> Filtered:
        target_variance, n_known = self._loops.filter_rows(
            self._measured,
            self._prediction,
            self._filters,
            self._targets,
            self._recall,
            variances,
            self._filter_constants,
        )
        return Filtered(target_variance, n_known)

    def steps(self, plan: StepPlan) -> Steps:
        scratch = _scratch(self._sizes)
        if scratch is not self._step_scratch:
            self._step_scratch = scratch
            self._step_inputs = self._inputs_with(scratch)
        self._of_steps = scratch.iterates.mean
        return Steps._make(self._loops.steps(self._step_inputs, self._measured, plan))

    def _inputs_with(self, scratch: Scratch) -> kernels.StepInputs:
        return kernels.StepInputs(
            transform=self._transform,
            prediction=self._prediction,
            targets=self._targets,
            iterates=scratch.iterates,
            tiles=self._maps,
            denoiser=kernels.Denoiser(
                self._weights, self._limits, scratch.steps, self._has_gates
            ),
            constants=self._step_constants,
        )

    def fade(self, part: float) -> None:
        rest = np.float32(1 - part)
        if rest == 1:
            return
        self._prediction.x[:] *= rest
        if self._of_steps is not self._prediction.x:
            self._of_steps[:] *= rest

    def settle(self, blend: Blend, ones: Floats) -> Settled:
        forces = np.empty(self._rows.n, dtype=np.float32)
        sums = self._loops.settle(
            *(self._of_steps, self._prediction, self._measured, ones, self._transform),
            *(self._estimate, blend, forces),
        )
        return Settled(forces, *sums)

    def mean_variance(self, forces: Floats, model: NoiseModel) -> float:
        variance: float = self._loops.variance(forces, _noise_curve(model))
        return variance


class Loops(NamedTuple):
    """The loops of a frame. Arguments of other types are not refused: a NamedTuple of numbers may
    be another class with the same fields.
    """

    begin: Callable[..., Any]
    predict: Callable[..., Any]
    filter_rows: Callable[..., Any]
    steps: Callable[..., Any]
    settle: Callable[..., Any]
    variance: Callable[..., Any]


@cache
def _loops() -> Loops:
    ready(*kernels.SKIN_LOOPS)
    return Loops(
        begin=entry_point(kernels.skin_begin),
        predict=entry_point(kernels.skin_predict),
        filter_rows=entry_point(kernels.skin_filter),
        steps=entry_point(kernels.skin_steps),
        settle=entry_point(kernels.skin_settle),
        variance=entry_point(kernels.skin_variance),
    )


class ScratchSizes(NamedTuple):
    """Sizes of the scratch of a frame."""

    n: int  # taxels
    n_cells: int  # cells of the canvas
    n_windows: int
    n_filters: int
    n_hidden: int


class Scratch(NamedTuple):
    """Scratch of a frame."""

    slopes: kernels.Slopes
    iterates: kernels.Iterates
    steps: Floats


_OF_THREAD = threading.local()


def _scratch(sizes: ScratchSizes) -> Scratch:
    """Scratch that the solvers of a thread share, so that it stays in its cache: nothing in it
    lasts from `predict` to `steps`.
    """
    if getattr(_OF_THREAD, "sizes", None) != sizes:
        _OF_THREAD.sizes = sizes
        _OF_THREAD.scratch = _make_scratch(sizes)
    scratch: Scratch = _OF_THREAD.scratch
    return scratch


def _make_scratch(sizes: ScratchSizes) -> Scratch:
    def floats(*shape: int) -> Floats:
        return np.zeros(shape, dtype=np.float32)

    n_steps = kernels.step_scratch_size(
        *(sizes.n, sizes.n_cells, sizes.n_windows, sizes.n_filters, sizes.n_hidden)
    )
    iterates = kernels.Iterates(*floats(3, sizes.n))
    slopes = kernels.Slopes(floats(2, sizes.n), floats(2, sizes.n))
    return Scratch(slopes, iterates, floats(n_steps))


@lru_cache(maxsize=16)
def _maps(tiles: Tiles) -> kernels.TileMaps:
    """Maps of a skin, of the windows with a taxel alone."""
    places = np.arange(tiles.canvas.size).reshape(tiles.canvas.shape)
    begins = np.zeros((len(SHIFTS), tiles.most), np.uint32)
    shares = np.zeros((len(SHIFTS), tiles.most), np.float32)
    kinds = np.zeros((len(SHIFTS), tiles.most), np.uint32)
    counts = np.zeros(len(SHIFTS), np.int64)
    kinds_of_shifts = deviations_of(tiles).kinds
    for shift, share in enumerate(tiles.shares):
        has_taxel = share > 0
        count = np.count_nonzero(has_taxel)
        counts[shift] = count
        begins[shift, :count] = tiles.cut(places, shift)[has_taxel, 0]
        shares[shift, :count] = share[has_taxel]
        kinds[shift, :count] = kinds_of_shifts[shift][has_taxel]

    width = tiles.canvas.shape[1]
    row, col = np.divmod(tiles.cells, tiles.shape[1])
    cells = (row + MARGIN) * width + col + MARGIN
    canvas = tiles.canvas.reshape(-1)
    return kernels.TileMaps(
        canvas=canvas.astype(np.uint32),
        cells=cells.astype(np.uint32),
        begins=begins,
        shares=shares,
        kinds=kinds,
        counts=counts,
        width=width,
    )


@lru_cache(maxsize=16)
def _neighbours(tiles: Tiles) -> kernels.A:
    """Neighbours as of `skin_slopes`."""
    return neighbours_of(tiles).reshape(4, -1).astype(np.uint32)


def _weights(gates: Gates) -> kernels.Weights:
    arrays = (
        gates.filters.T,
        gates.hidden.T,
        gates.hidden_0,
        gates.gates.T,
        gates.gates_0,
        gates.synthesis.T,
        gates.error[0],
    )
    contiguous = [np.ascontiguousarray(array) for array in arrays]
    return kernels.Weights._make([*contiguous, float(gates.error_0[0])])


def _step_constants(tuning: SkinTuning) -> kernels.StepConstants:
    return kernels.StepConstants(
        damping=tuning.damping,
        damped_from=tuning.damped_from,
        least_tau=tuning.least_tau,
        most_alpha=tuning.most_alpha,
        residual_power=tuning.residual_power,
        rise_power=tuning.rise_power,
        fully_averaged=tuning.fully_averaged,
        converged=CONVERGED,
        n_formula=N_FORMULA,
        formula_share=FORMULA_SHARE,
    )


def _filter_constants(tuning: SkinTuning) -> kernels.FilterConstants:
    return kernels.FilterConstants(
        prior=tuning.prior,
        doubt=tuning.doubt,
        recall_memory=tuning.recall_memory,
        recall_ridge=tuning.recall_ridge,
        motion_memory=tuning.motion_memory,
        most_recalled=tuning.most_recalled,
        most_confirmed=tuning.most_confirmed,
        unknown=UNKNOWN,
    )


@lru_cache(maxsize=16)
def _noise_curve(model: NoiseModel) -> kernels.NoiseCurve:
    return kernels.NoiseCurve(
        f_max=float(model.f_max),
        sigma_mid=float(model.sigma_mid),
        sigma_end=float(model.sigma_end),
        clips=float(model.clips),
        of_touched=float(model.of_touched),
        clipped=CLIPPED,
        clipped_below=CLIPPED_BELOW,
    )
