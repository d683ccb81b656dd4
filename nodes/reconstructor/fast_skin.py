"""The solver `skin` in compiled loops: its iteration, its prediction, what it
remembers of rows, and its last step."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Floats, Indices
from sparseskin.nodes.fast import ready
from sparseskin.nodes.fast_kernels import (
    compare_rows,
    follow_rows,
    give_back,
    move,
    skin_step,
    stay,
)
from sparseskin.nodes.reconstructor.fast_projection import CompiledProjection
from sparseskin.nodes.reconstructor.neighbours import Neighbours
from sparseskin.nodes.reconstructor.prediction import SIGNIFICANT, Prediction
from sparseskin.nodes.reconstructor.row_memory import RowMemory
from sparseskin.nodes.reconstructor.shifted_haar import SHIFTS, ShiftedHaar

Places = npt.NDArray[np.uint16]


class CompiledIteration:
    """What `SkinSolver.step` does to its vectors, which are float32 (n,) and stay the same.

    Parameters
    ----------
    projection : CompiledProjection
    haar : ShiftedHaar
        Of fewer than `MAX_PLACES` cells.
    vectors : tuple of ndarray
        x, z, r, the target of r, the sum of the iterates, the canvas, and u with a 0 behind it.
    m : int
        Number of measurements.
    momentum : float
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
        """Do one iteration.

        Parameters
        ----------
        shift : int
            Number of one of `SHIFTS`.
        threshold : float
            In root mean squares of r.
        least : float
            The least threshold, newtons.
        summed : bool
            Whether the new x is added to the sum.
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

    def _stay(self, x: Floats, y: Floats, misfit: Floats) -> float:
        projection = self._compiled
        return stay(
            *(x, y, projection.measured, projection.scale, projection.groups),
            *(self.whole, self._rows, misfit),
        )

    def _move(self, x: Floats, y: Floats, misfit: Floats, e2: float, s2: float) -> float:
        projection = self._compiled
        return move(
            *(x, y, misfit, e2, SIGNIFICANT * s2, self._after, self._before),
            *(self._terms, self._rows, projection.measured, projection.groups),
            *(self._moved, self._moved_misfit),
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

    def _follow(self, weight: float, counted: float, target: Floats) -> None:
        projection = self._compiled
        follow_rows(
            *(weight, counted, self.read, self._known, self._values, self._whole),
            *(projection.scale, self._weights, target),
        )
        projection.weights = self._weights


def compiled_forces(place_of_cell: Indices) -> Callable[[Floats, float], Floats]:
    """Return the function that turns a vector of means above the bias into forces of all cells.

    Parameters
    ----------
    place_of_cell : ndarray of intp, shape (n_cells,)
        Where the vector holds each cell.
    """
    ready(give_back)
    places = place_of_cell.astype(np.uint32)

    def forces_of(x: Floats, bias: float) -> Floats:
        forces = np.empty(places.size, dtype=np.float32)
        give_back(x, places, bias, forces)
        return forces

    return forces_of
