"""The work on vectors of the default solver in compiled loops, for `sbhe`; it needs numba."""

from __future__ import annotations

import threading
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.numerics import kernels
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.numerics.compiled import ready
from sparseskin.nodes.sensor.noise import CLIPPED, CLIPPED_BELOW, NoiseModel

from .formula import LEAST, STRICT
from .gates import CLEARLY, QUIET, STANDS_OUT, Gates
from .motion import Motion, MotionSums
from .rows import CompiledRows
from .tiles import MARGIN, SHIFTS, TILE, WINDOW, Tiles, neighbours_of
from .tuning import SkinTuning
from .vectors import (
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
        ready(*kernels.SKIN_LOOPS)
        n = rows.n
        self._rows = rows
        self._transform = kernels.Transform(rows.groups, rows.scale)
        self._maps = _maps(tiles)
        self._neighbours = _neighbours(tiles)
        self._has_gates = gates is not None
        self._weights = _weights(gates or Gates.zero())
        self._limits = _limits(tiles.strictness)
        self._sizes = ScratchSizes(
            n=n,
            n_averaged=max(1, tuning.averaged),
            n_cells=tiles.canvas.size,
            n_windows=tiles.most,
            n_filters=len(self._weights.filters),
            n_hidden=len(self._weights.hidden_0),
        )
        self._step_constants = kernels.StepConstants(
            tuning.damping, tuning.least_tau, tuning.most_alpha
        )
        self._filter_constants = kernels.FilterConstants(
            *(tuning.prior, tuning.doubt, tuning.recall_memory, tuning.recall_ridge, UNKNOWN)
        )

        vectors = np.zeros((10, n), dtype=np.float32)
        self._estimate = kernels.Estimate(*vectors[:3])
        self._prediction = kernels.Prediction(*vectors[3:5])
        self._filters = kernels.Filters(*vectors[5:8])
        self._targets = kernels.Targets(*vectors[8:])
        self._recall = np.zeros(3)
        self.x = self._estimate.x
        self.forget()

    def forget(self) -> None:
        self._recall[:] = 0
        self.x[:] = 0
        self.forget_rows()

    def forget_rows(self) -> None:
        self.start_from(self.x)
        self._estimate.correction[:] = 0
        self._filters.mean[:] = self._estimate.rows
        self._filters.variance[:] = UNKNOWN
        self._filters.change[:] = 0

    def start_from(self, x: Floats) -> None:
        self.x[:] = x
        self._estimate.rows[:] = self._rows.forward(x)

    def begin(self, values: Floats) -> MotionSums:
        of_read = np.empty((3, len(values)), dtype=np.float32)
        self._measured = kernels.Measured(self._rows.read, values, *of_read)
        self.innovation = self._measured.innovation
        self.residual = self._measured.residual

        aa, ab, ac, bb, bc, cc, *products, energy, largest = kernels.skin_slopes(
            *(self._estimate, self._measured, self._neighbours, self._transform),
            _scratch(self._sizes).slopes,
        )
        gram = ((aa, ab, ac), (ab, bb, bc), (ac, bc, cc))
        return MotionSums(gram, products, energy, largest, len(values), self._rows.n)

    def predict(self, motion: Motion) -> Innovation:
        sums = kernels.skin_predict(
            *(self._estimate, kernels.MotionWeights(*motion), _scratch(self._sizes).slopes),
            *(self._transform, self._measured, self._prediction, self._filters, UNKNOWN),
        )
        squares, correction_squares, products, n_known, filter_squares, filter_variances = sums
        self._estimates = self._prediction.x[None]
        return Innovation(
            squares=squares,
            correction_squares=correction_squares,
            products=products,
            n_read=len(self.innovation),
            n_known=n_known,
            filter_squares=filter_squares,
            filter_variances=filter_variances,
        )

    def filter_rows(self, variances: RowVariances) -> Filtered:
        target_variance, n_known = kernels.skin_filter(
            *(self._measured, self._prediction, self._filters, self._targets, self._recall),
            *(kernels.Variances(*variances), self._filter_constants),
        )
        return Filtered(target_variance, n_known)

    def steps(self, plan: StepPlan) -> Steps:
        scratch = _scratch(self._sizes)
        n_formula = plan.n_formula
        self._estimates = scratch.iterates.estimates[: plan.n]
        if not self._has_gates:  # all steps are by the formula
            n_formula = plan.n_formula + plan.n
        scratch.iterates.z[:] = self._prediction.x

        inputs = kernels.StepInputs(
            transform=self._transform,
            measured=self._measured,
            targets=self._targets,
            iterates=kernels.Iterates(scratch.iterates.z, self._estimates),
            tiles=self._maps,
            denoiser=kernels.Denoiser(self._weights, self._limits, scratch.steps),
            plan=kernels.Plan(
                n_formula=n_formula,
                n=plan.n_formula + plan.n - n_formula,
                first_shift=plan.first_shift,
                target_variance=plan.target_variance,
                floor=plan.floor,
            ),
            constants=self._step_constants,
        )
        return Steps(*kernels.skin_steps(inputs))

    def clear(self) -> None:
        self._prediction.x[:] = 0
        self._estimates[:] = 0

    def settle(self, blend: Blend, ones: Floats) -> Settled:
        forces = np.empty(self._rows.n, dtype=np.float32)
        sums = kernels.skin_settle(
            *(self._estimates, self._prediction, self._measured, ones, self._transform),
            *(self._estimate, kernels.BlendNumbers(*blend), forces),
        )
        return Settled(forces, *sums)

    def mean_variance(self, forces: Floats, model: NoiseModel) -> float:
        variance: float = kernels.skin_variance(forces, _noise_curve(model))
        return variance


class ScratchSizes(NamedTuple):
    """Sizes of the scratch of a frame."""

    n: int  # taxels
    n_averaged: int  # estimates that are averaged
    n_cells: int  # cells of the canvas
    n_windows: int
    n_filters: int
    n_hidden: int


class Scratch(NamedTuple):
    """Scratch of a frame."""

    slopes: kernels.Slopes
    iterates: kernels.Iterates
    steps: kernels.StepScratch


_OF_THREAD = threading.local()


def _scratch(sizes: ScratchSizes) -> Scratch:
    """Scratch that the solvers of a thread share, so that it stays in its cache. Nothing in it lasts
    from `setup` to `finish`.
    """
    if getattr(_OF_THREAD, "sizes", None) != sizes:
        _OF_THREAD.sizes = sizes
        _OF_THREAD.scratch = _make_scratch(sizes)
    scratch: Scratch = _OF_THREAD.scratch
    return scratch


def _make_scratch(sizes: ScratchSizes) -> Scratch:
    def floats(*shape: int) -> Floats:
        return np.zeros(shape, dtype=np.float32)

    n_windows = sizes.n_windows
    steps = kernels.StepScratch(
        v=floats(sizes.n + 1),
        image=floats(sizes.n_cells),
        denoised=floats(sizes.n_cells),
        w=floats(n_windows, WINDOW * WINDOW),
        a=floats(n_windows, sizes.n_filters),
        levels=floats(n_windows, 2 * sizes.n_filters),
        h=floats(n_windows, sizes.n_hidden),
        g=floats(n_windows, sizes.n_filters + 1),
        tiles=floats(n_windows, TILE * TILE),
        sums=floats(85, n_windows),
        details=floats(65, n_windows),
        parts=floats(n_windows),
        busy=np.zeros(n_windows, dtype=np.int64),
    )
    iterates = kernels.Iterates(floats(sizes.n), floats(sizes.n_averaged, sizes.n))
    slopes = kernels.Slopes(floats(2, sizes.n), floats(2, sizes.n))
    return Scratch(slopes, iterates, steps)


@lru_cache(maxsize=16)
def _maps(tiles: Tiles) -> kernels.TileMaps:
    """Maps of a skin, of the windows with a taxel alone."""
    places = np.arange(tiles.canvas.size).reshape(tiles.canvas.shape)
    begins = np.zeros((len(SHIFTS), tiles.most), np.uint32)
    shares = np.zeros((len(SHIFTS), tiles.most), np.float32)
    counts = np.zeros(len(SHIFTS), np.int64)
    for shift, share in enumerate(tiles.shares):
        has_taxel = share > 0
        count = np.count_nonzero(has_taxel)
        counts[shift] = count
        begins[shift, :count] = tiles.cut(places, shift)[has_taxel, 0]
        shares[shift, :count] = share[has_taxel]

    width = tiles.canvas.shape[1]
    row, col = np.divmod(tiles.cells, tiles.shape[1])
    cells = (row + MARGIN) * width + col + MARGIN
    canvas = tiles.canvas.reshape(-1)
    return kernels.TileMaps(
        canvas.astype(np.uint32), cells.astype(np.uint32), begins, shares, counts, width
    )


@lru_cache(maxsize=16)
def _neighbours(tiles: Tiles) -> kernels.A:
    """Neighbours as of `skin_slopes`."""
    return neighbours_of(tiles).reshape(4, -1).astype(np.uint32)


def _weights(gates: Gates) -> kernels.Weights:
    arrays = (
        *(gates.filters, gates.hidden, gates.hidden_0, gates.gates, gates.gates_0),
        *(gates.synthesis, gates.error[0]),
    )
    return kernels.Weights(*map(np.ascontiguousarray, arrays), float(gates.error_0[0]))


def _limits(strictness: float) -> kernels.Limits:
    single, by_3, by_6, whole = (strictness * limit for limit in STANDS_OUT)
    return kernels.Limits(single, by_3, by_6, whole, CLEARLY, QUIET, STRICT, LEAST)


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
