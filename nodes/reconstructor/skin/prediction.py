"""Prediction of a frame from the last: the same contact, moved a little, pressed differently."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.reconstructor.solvers.projection import Projection

from .tuning import TUNING, SkinTuning


class Prediction:
    """Predicts a frame from the last by least squares on the measurements.

    x + a x + b dx/drow + c dx/dcol: a force that grows or fades, a contact that slides. It is used
    only if it explains the measurements significantly better than x, so that noise does not blur
    a still scene.

    Attributes
    ----------
    failed : bool
        True if the last frame predicted worse than 0, which was used instead.
    moved : bool
        True if the prediction differs from the last frame.
    whole : ndarray of float32, shape (n_rows,)
        W x of the last frame; Phi x if the projection has no other rows.
    knows_whole : bool
        True if `whole` is set already when `predict` is called; False again after it.
    """

    def __init__(
        self,
        projection: Projection,
        neighbours: Indices,
        n: int,
        m: int,
        tuning: SkinTuning = TUNING,
    ) -> None:
        self._t = tuning
        self._m = m
        self._freedom = max(0, m - 3) / 3
        self.failed = self.moved = self.knows_whole = False
        self._projection = projection
        self._after, self._before = neighbours
        self._shifted = np.zeros((2, 2, n), dtype=np.float32)
        self._terms = np.zeros((3, n), dtype=np.float32)
        self._rows = np.zeros((3, projection.n_rows), dtype=np.float32)
        self._moved = np.zeros(n, dtype=np.float32)
        self.whole = np.zeros(projection.n_rows, dtype=np.float32)
        self._moved_innovation = np.zeros(projection.n_rows, dtype=np.float32)

    def predict(
        self, x: Floats, y: Floats, innovation: Floats, s2: float, changed2: float = math.inf
    ) -> float:
        """Predict a frame; return the squared length of the innovation.

        Parameters
        ----------
        x : ndarray of float32, shape (n,)
            The last frame; becomes the prediction.
        y, innovation : ndarray of float32, shape (n_rows,)
            Measurements as a vector of rows; becomes y - Phi x of the prediction.
        s2 : float
            Variance of the noise on a measurement.
        changed2 : float
            Squared length of the change of y since the same rows were read last; infinite if they
            were not. Where they changed less than a motion leaves unexplained, nothing has moved,
            and nothing has vanished.
        """
        y2 = float(np.dot(y, y))
        self.failed = self.moved = False
        if not float(np.dot(x, x)) > 0:
            self.whole.fill(0)
            self.knows_whole = False
            np.copyto(innovation, y)
            return y2
        e2 = self._stay(x, y, innovation)
        self.knows_whole = False
        if e2 > self._t.motion_still * self._m * s2:
            still_e2, e2 = e2, self._move(x, y, innovation, e2, s2, min(e2, changed2))
            self.moved = e2 < still_e2
        # A vanished contact still fits a little, scaled down to next to nothing.
        least = min(e2, changed2)
        self.failed = (
            least > self._t.failed_part * y2 and least > self._t.failed_noise * self._m * s2
        )
        if self.failed:
            self.moved = True
            x.fill(0)
            np.copyto(innovation, y)
            return y2
        return e2

    def _stay(self, x: Floats, y: Floats, innovation: Floats) -> float:
        """Compute the innovation of x itself; return its squared length."""
        if self._projection.has_whole:
            if not self.knows_whole:
                self._projection.whole(x, self.whole)
            np.multiply(self.whole, self._projection.read, self._rows[0])
        else:
            self._projection.forward(x[None], self._rows[:1])
            np.copyto(self.whole, self._rows[0])
        np.subtract(y, self._rows[0], innovation)
        return float(np.dot(innovation, innovation))

    def _fill_terms(self, x: Floats) -> None:
        """Set `_terms` to x and its differences along rows and columns."""
        after, before = self._shifted
        x.take(self._after, None, after, "clip")
        x.take(self._before, None, before, "clip")
        np.copyto(self._terms[0], x)
        np.subtract(after, before, self._terms[1:])

    def _move(
        self, x: Floats, y: Floats, innovation: Floats, e2: float, s2: float, most: float
    ) -> float:
        """Fit and add the terms to x; return the squared length of the innovation then.

        They are added only if less than `most` is left.
        """
        rows = self._rows
        self._fill_terms(x)
        self._projection.forward(self._terms[1:], rows[1:])
        gram = [[float(np.dot(a, b)) for b in rows[: k + 1]] for k, a in enumerate(rows)]
        right = [float(np.dot(row, innovation)) for row in rows]
        largest = max(gram[k][k] for k in range(3))
        if not 0 < largest < math.inf:
            return e2
        found = _solve(gram, right, 1e-6 * largest)
        explained = sum(c * r for c, r in zip(found, right, strict=True))
        if not (
            explained > self._t.motion_significant * s2
            and explained * self._freedom > max(0.0, e2 - explained)
        ):
            return e2
        moved = np.dot(np.array(found, dtype=np.float32), self._terms, self._moved)
        np.add(x, moved, moved)
        # The unobserved part must not grow without bound, frame after frame.
        np.clip(moved, 0, float(x.max()) * max(1.0, 1 + found[0]), out=moved)
        moved_innovation = self._moved_innovation
        self._projection.forward(moved[None], moved_innovation[None])
        np.subtract(y, moved_innovation, moved_innovation)
        moved_e2 = float(np.dot(moved_innovation, moved_innovation))
        if not moved_e2 < most:
            return e2
        np.copyto(x, moved)
        np.copyto(innovation, moved_innovation)
        return moved_e2


def _solve(gram: list[list[float]], right: list[float], ridge: float) -> list[float]:
    """Solve three normal equations, their lower triangle given, by cofactors."""
    a, b, c = gram[0][0] + ridge, gram[1][0], gram[2][0]
    d, e, f = gram[1][1] + ridge, gram[2][1], gram[2][2] + ridge
    first = (d * f - e * e, c * e - b * f, b * e - c * d)
    determinant = a * first[0] + b * first[1] + c * first[2]
    second = (first[1], a * f - c * c, b * c - a * e)
    third = (first[2], b * c - a * e, a * d - b * b)
    return [
        sum(k * r for k, r in zip(row, right, strict=True)) / determinant
        for row in (first, second, third)
    ]


def neighbours_of(place_of_cell: Indices, n: int) -> Indices:
    """Return the places of the next and the last neighbour of each taxel along rows and columns.

    The result is intp (next or last, rows or columns, n); a missing neighbour is the taxel itself.
    place_of_cell and n are as in `ShiftedHaar`.
    """
    found = np.empty((2, 2, n), dtype=np.intp)
    exists = place_of_cell < n
    edged = np.pad(place_of_cell, 1, constant_values=n)
    sides = ((edged[2:, 1:-1], edged[1:-1, 2:]), (edged[:-2, 1:-1], edged[1:-1, :-2]))
    for which, axis in np.ndindex(2, 2):
        other = np.where(sides[which][axis] < n, sides[which][axis], place_of_cell)
        found[which, axis, place_of_cell[exists]] = other[exists]
    return found
