"""The solver `skin` in compiled loops: iteration, prediction, row memory, and final forces."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.numerics.compiled import ready
from sparseskin.nodes.numerics.kernels import (
    add_bias,
    compare_rows,
    follow_rows,
    move,
    skin_step,
    stay,
)
from sparseskin.nodes.reconstructor.bases.shifted_haar import SHIFTS, ShiftedHaar
from sparseskin.nodes.reconstructor.solvers.fast import CompiledProjection

from .prediction import Prediction
from .row_memory import RowMemory
from .tuning import SkinTuning


def compiled_iteration(
    projection: CompiledProjection,
    haar: ShiftedHaar,
    vectors: tuple[Floats, ...],
    m: int,
    momentum: float,
) -> Callable[[int, float, float, bool], None]:
    """Return the function that does the iteration of `SkinSolver` on its vectors.

    `haar` is of fewer than `MAX_PLACES` cells; the vectors, float32 (n,), are x, z, r, the target
    of r, the sum of the iterates, the canvas, and u with a 0 behind it.
    """
    ready(skin_step)
    x, z, r, target, total, canvas, u = vectors
    root_m = math.sqrt(m)
    tables = [
        [places.astype(np.uint16) for places in haar.tables(shift)] for shift in range(len(SHIFTS))
    ]

    def iterate(shift: int, threshold: float, least: float, summed: bool) -> None:
        to_canvas, from_canvas = tables[shift]
        skin_step(
            *(x, z, r, target, total, to_canvas, from_canvas, canvas, u),
            *(projection.weights, projection.groups),
            threshold / root_m,
            least,
            momentum,
            summed,
        )

    return iterate


class CompiledPrediction(Prediction):
    """As `Prediction`."""

    def __init__(
        self,
        projection: CompiledProjection,
        neighbours: Indices,
        n: int,
        m: int,
        tuning: SkinTuning,
    ) -> None:
        super().__init__(projection, neighbours, n, m, tuning)
        ready(stay, move)
        self._compiled = projection
        self._places = neighbours.astype(np.uint32)

    def _stay(self, x: Floats, y: Floats, innovation: Floats) -> float:
        projection = self._compiled
        return stay(
            *(x, self.knows_whole, y, projection.read, projection.scale, projection.groups),
            *(self.whole, self._rows, innovation),
        )

    def _move(
        self, x: Floats, y: Floats, innovation: Floats, e2: float, s2: float, most: float
    ) -> float:
        projection, (after, before) = self._compiled, self._places
        return move(
            *(x, y, innovation, e2, most),
            *(self._t.motion_significant * s2, self._freedom, after, before),
            *(self._terms, self._rows, projection.measured, projection.groups),
            *(self._moved, self._moved_innovation),
        )


class CompiledRowMemory(RowMemory):
    """As `RowMemory`."""

    def __init__(
        self, projection: CompiledProjection, m: int, whole: Floats, tuning: SkinTuning
    ) -> None:
        super().__init__(projection, m, whole, tuning)
        ready(compare_rows, follow_rows)
        self._compiled = projection

    def _compare(self, x: Floats | None, y: Floats) -> float:
        projection = self._compiled
        return compare_rows(
            *(y if x is None else x, x is not None, y, self.read),
            *(projection.scale, projection.groups, self._whole, self.values, self._rows),
        )

    def _follow(self, gain: float, counted: float, target: Floats) -> None:
        projection = self._compiled
        follow_rows(
            *(gain, counted, self.read, self.known, self.values, self._whole),
            *(projection.scale, self._weights, target),
        )
        projection.weights = self._weights


def compiled_forces(place_of_cell: Indices) -> Callable[[Floats, float], Floats]:
    """Return the function that computes forces of all cells from a vector of means above the bias.

    place_of_cell, intp (n_cells,), is the place in that vector of each cell.
    """
    ready(add_bias)
    places = place_of_cell.astype(np.uint32)

    def forces_of(x: Floats, bias: float) -> Floats:
        forces = np.empty(places.size, dtype=np.float32)
        add_bias(x, places, bias, forces)
        return forces

    return forces_of
