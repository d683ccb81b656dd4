"""The solver `skin` in compiled loops: iteration, prediction, row memory, and final forces."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

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

from .prediction import SIGNIFICANT, Neighbours, Prediction
from .row_memory import RowMemory

Places = npt.NDArray[np.uint16]


class CompiledIteration:
    """The iteration of `SkinSolver` on its vectors, which are bound once.

    `haar` is of fewer than `MAX_PLACES` cells; the vectors, float32 (n,), are x, z, r, the target
    of r, the sum of the iterates, the canvas, and u with a 0 behind it.
    """

    def __init__(
        self,
        projection: CompiledProjection,
        haar: ShiftedHaar,
        vectors: tuple[Floats, ...],
        m: int,
        momentum: float,
    ) -> None:
        ready(skin_step)
        self._projection = projection
        self._vectors = vectors
        self._root_m = math.sqrt(m)
        self._momentum = momentum
        self._tables: list[tuple[Places, Places]] = []
        for shift in range(len(SHIFTS)):
            to_canvas, from_canvas = haar.tables(shift)
            self._tables.append((to_canvas.astype(np.uint16), from_canvas.astype(np.uint16)))

    def __call__(self, shift: int, threshold: float, least: float, summed: bool) -> None:
        """Do one iteration under a shift, the number of one of `SHIFTS`.

        The threshold is in RMS of r, the least one in newtons; if `summed`, x is added to the sum.
        """
        x, z, r, target, total, canvas, u = self._vectors
        to_canvas, from_canvas = self._tables[shift]
        skin_step(
            *(x, z, r, target, total, to_canvas, from_canvas, canvas, u),
            *(self._projection.weights, self._projection.groups),
            threshold / self._root_m,
            least,
            self._momentum,
            summed,
        )


class CompiledPrediction(Prediction):
    """As `Prediction`."""

    def __init__(
        self, projection: CompiledProjection, neighbours: Neighbours, n: int, m: int
    ) -> None:
        super().__init__(projection, neighbours, n, m)
        ready(stay, move)
        self._compiled = projection
        self._after, self._before = (places.astype(np.uint32) for places in neighbours.places)

    def _stay(self, x: Floats, y: Floats, innovation: Floats) -> float:
        projection = self._compiled
        return stay(
            *(x, y, projection.measured, projection.scale, projection.groups),
            *(self.whole, self._rows, innovation),
        )

    def _move(self, x: Floats, y: Floats, innovation: Floats, e2: float, s2: float) -> float:
        projection = self._compiled
        return move(
            *(x, y, innovation, e2, SIGNIFICANT * s2, self._after, self._before),
            *(self._terms, self._rows, projection.measured, projection.groups),
            *(self._moved, self._moved_innovation),
        )


class CompiledRowMemory(RowMemory):
    """As `RowMemory`."""

    def __init__(self, projection: CompiledProjection, m: int, whole: Floats) -> None:
        super().__init__(projection, m, whole)
        ready(compare_rows, follow_rows)
        self._compiled = projection

    def _compare(self, x: Floats | None, y: Floats) -> float:
        projection = self._compiled
        return compare_rows(
            *(y if x is None else x, x is not None, y, self.read),
            *(projection.scale, projection.groups, self._whole, self._values, self._rows),
        )

    def _follow(self, gain: float, counted: float, target: Floats) -> None:
        projection = self._compiled
        follow_rows(
            *(gain, counted, self.read, self._known, self._values, self._whole),
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
