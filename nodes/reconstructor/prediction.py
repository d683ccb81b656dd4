"""What the last frame says of the next: the same contact, moved a little, pressed otherwise."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.reconstructor.neighbours import Neighbours
from sparseskin.nodes.reconstructor.projection import Projection

#: Reduction of the squared misfit, in noise variances, that three free numbers have to earn.
#: Noise alone gives them 3 on average, and 12 in less than one frame of a hundred.
SIGNIFICANT = 12.0
#: Misfit, in what noise leaves of it on average, up to which nothing is taken to have moved.
STILL = 0.95
#: A prediction that leaves this part of the measurements' energy, and more of it than noise
#: does, has failed.
HARDLY, DOUBTFUL = 0.5, 2.0


class Prediction:
    """Predicts a frame from the last by least squares on the measurements.

    x + a x + b dx/drow + c dx/dcol: a force that grows or fades, a contact that slides. It is
    taken only where it explains the measurements significantly better than x does, so that a
    still scene is not blurred by noise.

    Parameters
    ----------
    projection : Projection
    neighbours : Neighbours
    n, m : int
        Number of taxels and of measurements.

    Attributes
    ----------
    failed : bool
        Whether the last frame was worse than none, and nothing was predicted from it.
    moved : bool
        Whether the prediction is another than the last frame.
    whole : ndarray of float32, shape (n_rows,)
        W x of the last frame, where the projection has all rows of one W.
    """

    def __init__(self, projection: Projection, neighbours: Neighbours, n: int, m: int) -> None:
        self._m = m
        self.failed = self.moved = False
        self._projection = projection
        self._neighbours = neighbours
        self._terms = np.zeros((3, n), dtype=np.float32)
        self._rows = np.zeros((3, projection.n_rows), dtype=np.float32)
        self._moved = np.zeros(n, dtype=np.float32)
        self.whole = np.zeros(projection.n_rows, dtype=np.float32)
        self._moved_misfit = np.zeros(projection.n_rows, dtype=np.float32)

    def predict(self, x: Floats, y: Floats, misfit: Floats, s2: float) -> float:
        """Predict a frame.

        Parameters
        ----------
        x : ndarray of float32, shape (n,)
            The last frame; becomes the prediction.
        y : ndarray of float32, shape (n_rows,)
            Measurements, a vector of rows.
        misfit : ndarray of float32, shape (n_rows,)
            Becomes y - Phi x of the prediction.
        s2 : float
            Variance of the noise on a measurement.

        Returns
        -------
        float
            Squared length of the misfit.
        """
        y2 = float(np.dot(y, y))
        self.failed = self.moved = False
        if not float(np.dot(x, x)) > 0:
            self.whole.fill(0)
            np.copyto(misfit, y)
            return y2
        e2 = self._stay(x, y, misfit)
        if e2 > STILL * self._m * s2:
            still_e2, e2 = e2, self._move(x, y, misfit, e2, s2)
            self.moved = e2 < still_e2
        # A contact that has vanished is still worth a little: scaled down to next to nothing.
        self.failed = e2 > HARDLY * y2 and e2 > DOUBTFUL * self._m * s2
        if self.failed:
            self.moved = True
            x.fill(0)
            np.copyto(misfit, y)
            return y2
        return e2

    def _stay(self, x: Floats, y: Floats, misfit: Floats) -> float:
        """Find the misfit of x as it is, and its squared length."""
        if self._projection.has_whole:
            self._projection.whole(x, self.whole)
            np.multiply(self.whole, self._projection.measured, self._rows[0])
        else:
            self._projection.forward(x[None], self._rows[:1])
        np.subtract(y, self._rows[0], misfit)
        return float(np.dot(misfit, misfit))

    def _fill_terms(self, x: Floats) -> None:
        """x, and its differences along rows and columns."""
        terms, neighbours = self._terms, self._neighbours
        neighbours.gather(x)
        np.copyto(terms[0], x)
        np.subtract(neighbours.after, neighbours.before, terms[1:])

    def _move(self, x: Floats, y: Floats, misfit: Floats, e2: float, s2: float) -> float:
        """Add the terms that the misfit asks for; its squared length then."""
        rows = self._rows
        self._fill_terms(x)
        self._projection.forward(self._terms[1:], rows[1:])
        gram = [[float(np.dot(a, b)) for b in rows[: k + 1]] for k, a in enumerate(rows)]
        right = [float(np.dot(row, misfit)) for row in rows]
        largest = max(gram[k][k] for k in range(3))
        if not 0 < largest < math.inf:
            return e2
        found = _solve(gram, right, 1e-6 * largest)
        if not sum(c * r for c, r in zip(found, right, strict=True)) > SIGNIFICANT * s2:
            return e2
        moved = np.dot(np.array(found, dtype=np.float32), self._terms, self._moved)
        np.add(x, moved, moved)
        # What no measurement sees must not grow without bound, frame after frame.
        np.clip(moved, 0, float(x.max()) * max(1.0, 1 + found[0]), out=moved)
        moved_misfit = self._moved_misfit
        self._projection.forward(moved[None], moved_misfit[None])
        np.subtract(y, moved_misfit, moved_misfit)
        moved_e2 = float(np.dot(moved_misfit, moved_misfit))
        if not moved_e2 < e2:
            return e2
        np.copyto(x, moved)
        np.copyto(misfit, moved_misfit)
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
