"""The smooth model of a frame: pressure whose variance and correlation length are known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Floats, Indices, Mask
from sparseskin.nodes.reconstructor.solvers.projection import Projection

from .tuning import TUNING, SkinTuning

#: Side of a grid up to which its correlation is a full matrix, and distance beyond which it is 0
#: in a sparse one, in its lengths.
MOST_DENSE, NEGLIGIBLE = 256, 4.0
#: Distance beyond which a Gaussian is 0, in its lengths; derived: below the square of float32's
#: rounding it changes no bit of a sum, and far above 2^-63 the product of two is not subnormal.
REACH = math.sqrt(-2 * math.log(2**-48))


class SmoothModel:
    """Estimates a frame as a Gaussian field whose deviation follows the last estimate.

    x = k x_p + C W^T (W C W^T + V)^-1 (y - k W x_p),  C = s^2 diag(d) K diag(d)

    K is the correlation of taxels by their distance, d the last estimate, blurred, as the
    deviation of each taxel, s^2 fits the mean square of the right side, V is the variance of the
    rows: noise for those of this frame, growing with the age of a remembered one. The system is
    solved by conjugate gradients, and d by iterating: taxels outside the contact lose their
    variance. A step along the residual follows, each row weighted by its variance, and x >= 0.

    It suits what Haar does not: dense smooth pressure, and skins of few taxels. Where noise
    dominates or edges are sharp, Haar is better.

    Parameters
    ----------
    projection : Projection
        W, in the order of its vectors.
    taxels : ndarray of intp, shape (n,)
        Cell of the grid that each place of a vector holds.
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    direct : bool
        True to solve by the factors of the system, for at most `most_direct` taxels. Each
        measurement is then also predicted from all others (`left_out`).
    tuning : SkinTuning
        The constants.

    Attributes
    ----------
    x : ndarray of float32, shape (n,)
        The estimate, newtons.
    rounds_left : int
        Rounds until it is complete.
    left_out : ndarray of float32, shape (n_rows,), or None
        Residual that each measurement would have if it had been left out, newtons; None without
        `direct`.

    Notes
    -----
    Source: Rasmussen, Williams, "Gaussian processes for machine learning", MIT Press 2006: section
    2.2 for the estimate, 5.4.2 for measurements left out one by one; Gorodnitsky, Rao, "Sparse
    signal reconstruction from limited data using FOCUSS", IEEE Trans. Signal Processing 45(3),
    1997, for a variance that follows the estimate.
    """

    #: Stated time of a conjugate gradient, seconds a taxel. [Measured: 15e-9 to 35e-9 of 40 x 40 to
    #: 256 x 256 taxels.] 0 where it need not be counted.
    gradient_s = 25e-9

    def __init__(
        self,
        projection: Projection,
        taxels: Indices,
        mask: Mask,
        direct: bool = False,
        tuning: SkinTuning = TUNING,
    ) -> None:
        self._t = tuning
        self._projection = projection
        self._taxels = taxels
        n = taxels.size
        self._ones: Floats = np.ones(n, dtype=np.float32)
        #: Vectors of conjugate gradients.
        self._vectors = np.zeros((5, projection.n_rows), dtype=np.float32)
        self._make_filters(mask)
        self.rounds_left = 0
        self.left_out: Floats | None = None
        self._direct = direct
        if direct:
            self._correlation = self._correlation_of(mask.shape)
            #: W, float32 (n_rows, n).
            self._dense: Floats = np.zeros((0, n), dtype=np.float32)

    def _make_filters(self, mask: Mask) -> None:
        """Prepare the correlation K and the blur of the deviation."""
        (n_rows, n_cols), n = mask.shape, self._taxels.size
        lengths = self._t.lengths
        down, right = ([_gaussian(side, length) for length in lengths] for side in mask.shape)
        # K of an image X is the sum of L_k X R_k: X (R_1 R_2 ...), read as rows of all lengths in
        # turn, is multiplied by the columns of all L_k in turn.
        turns = np.arange(len(lengths) * n_rows).reshape(len(lengths), n_rows).T.ravel()
        self._down = _side_by_side(down).T[turns].T
        self._right = _side_by_side(right) / np.float32(len(lengths))
        self._is_dense = max(mask.shape) <= MOST_DENSE
        self._blur = _gaussian(n_rows, self._t.blur), _gaussian(n_cols, self._t.blur)
        self._x_and_zero, self._back = np.zeros((2, n + 1), dtype=np.float32)
        self._place_of_cell = np.full(mask.size, n, dtype=np.intp)
        self._place_of_cell[self._taxels] = np.arange(n)
        self._image, self._total = np.zeros((2, n_rows, n_cols), dtype=np.float32)
        self._half = np.zeros((n_rows, len(lengths) * n_cols), dtype=np.float32)
        self._neighbours: Floats = self._blurred(self._ones) + np.float32(TINY)

    def setup(
        self,
        x: Floats,
        values: Floats,
        variance: Floats,
        used: Floats,
        power: float,
        cold: bool,
        kept: float,
    ) -> None:
        """Begin a frame.

        Parameters
        ----------
        x : ndarray of float32, shape (n,)
            Prediction, newtons.
        values, variance, used : ndarray of float32, shape (n_rows,)
            Measurements, the variance of each in squared newtons, and 1 where one is used, 0 where
            not.
        power : float
            Mean square of the measurements of this frame that are not noise, squared newtons.
        cold : bool
            True if the prediction is worth nothing.
        kept : float
            Part of the prediction that is kept, k.
        """
        self._start = np.zeros_like(x) if cold else np.float32(kept) * x
        self._values, self._variance, self._used = values, variance, used
        self._known = used * (values - self._rows(self._start)) if not cold else used * values
        self._gradients = self._t.cold_gradients if cold else self._t.gradients
        self.rounds_left = self._t.cold_rounds if cold else self._t.rounds
        self._deviation = self._ones if cold else self._deviation_of(x)
        self.x = x
        self._power = power
        if self._direct and (self._dense.size == 0 or not self._projection.has_whole):
            self._dense = np.array(
                [self._adjoint(one) for one in np.eye(used.size, dtype=np.float32)]
            )

    @property
    def least_s(self) -> float:
        """Stated time of a frame that has a prediction, seconds."""
        return self._t.rounds * self._t.gradients * self._taxels.size * self.gradient_s

    @property
    def left_s(self) -> float:
        """Stated time of the rounds that are left of the frame, seconds."""
        return self.rounds_left * self._gradients * self._taxels.size * self.gradient_s

    def round(self) -> None:
        """Do one round, of `rounds_left`; x, float32 (n,), is the estimate after it."""
        deviation = self._deviation
        variance = float(np.vdot(deviation, deviation)) / self._taxels.size
        used = self._used
        n_used = float(np.dot(used, used))
        scale = float(np.dot(self._known, self._known)) / max(n_used * variance, TINY)
        scale = max(scale, TINY * max(1.0, float(self._variance.max())))
        solve = self._invert if self._direct else self._descend
        field = solve(variance, self._variance * np.float32(1 / scale))
        x = np.maximum(self._start + field, 0)
        self.rounds_left -= 1
        if self.rounds_left:
            self._deviation = self._deviation_of(x)
        else:
            gain = self._power / (self._power + self._variance + TINY) * used
            residual = (gain * (self._values - self._rows(x))).astype(np.float32)
            step = np.float32(self._projection.step_size) * self._adjoint(residual)
            x = np.maximum(x + step, 0)
        self.x = x

    def _invert(self, mean: float, variance: Floats) -> Floats:
        """As `_descend`, by Cholesky's factors of the system."""
        from scipy import linalg  # here: most skins do not need it

        used, deviation = np.flatnonzero(self._used), self._deviation
        scaled = self._dense[used] * deviation
        correlated = scaled @ self._correlation
        system = (correlated @ scaled.T).astype(np.float64)
        system[np.diag_indices_from(system)] += self._t.model_error * mean + variance[used] + TINY
        factor = linalg.cho_factor(system, lower=True, overwrite_a=True, check_finite=False)
        found = linalg.cho_solve(factor, self._known[used], check_finite=False)
        if self.rounds_left == 1:
            # Of the inverse, the diagonal alone, and of this frame's rows.
            tested = np.flatnonzero(self._projection.read[used] > 0)
            ones = np.zeros((used.size, tested.size))
            ones[tested, np.arange(tested.size)] = 1
            columns = linalg.cho_solve(factor, ones, check_finite=False)
            diagonal = columns[tested, np.arange(tested.size)]
            left_out = found[tested] / diagonal * math.sqrt(1 + self._t.fitted / used.size)
            self.left_out = np.zeros_like(self._used)
            self.left_out[used[tested]] = left_out
        field: Floats = (deviation * (found @ correlated)).astype(np.float32)
        return field

    def _correlation_of(self, shape: tuple[int, ...]) -> Floats:
        """Return K of all taxels, float32 (n, n)."""
        places = np.stack(np.unravel_index(self._taxels, shape), axis=1)
        distance2 = np.square(places[:, None] - places).sum(axis=2)
        found = [np.exp(-0.5 * distance2 / length**2) for length in self._t.lengths]
        correlation: Floats = np.mean(found, axis=0).astype(np.float32)
        return correlation

    def _descend(self, mean: float, variance: Floats) -> Floats:
        """Return C W^T (W C W^T + V)^-1 of the known rows, by conjugate gradients."""
        used, known = self._used, self._known
        found, residual, direction, product, scaled = self._vectors
        added = np.where(used > 0, variance + np.float32(self._t.model_error * mean), np.float32(1))
        inverse = np.reciprocal(added + np.float32(mean), dtype=np.float32)
        found.fill(0)
        np.copyto(residual, known)
        np.multiply(inverse, residual, direction)
        slope = float(np.dot(residual, direction))
        enough = self._t.precise * float(np.dot(known, known))
        for _ in range(self._gradients):
            if not float(np.dot(residual, residual)) > enough:
                break
            self._projection.whole(self._correlated(direction), product)
            product *= used
            np.multiply(added, direction, scaled)
            product += scaled
            curvature = float(np.dot(direction, product))
            if not (curvature > 0 and slope > 0):
                break
            step = np.float32(slope / curvature)
            np.multiply(direction, step, scaled)
            found += scaled
            product *= step
            residual -= product
            np.multiply(inverse, residual, scaled)
            last, slope = slope, float(np.dot(residual, scaled))
            direction *= np.float32(slope / last)
            direction += scaled
        return self._correlated(found)

    def _correlated(self, rows: Floats) -> Floats:
        """Return C W^T rows, float32 (n,), until the next call."""
        image = self._image_of(self._adjoint(rows) * self._deviation)
        total = self._total
        if self._is_dense:
            np.dot(image, self._right, self._half)
            np.dot(self._down, self._half.reshape(-1, image.shape[1]), total)
        else:
            total = self._down @ (image @ self._right).reshape(-1, image.shape[1])
        back = self._back[:-1]
        total.reshape(-1).take(self._taxels, None, back, "clip")
        back *= self._deviation
        return back

    def _image_of(self, x: Floats) -> Floats:
        """Return the image of x, float32 (n,), until the next call."""
        self._x_and_zero[:-1] = x
        self._x_and_zero.take(self._place_of_cell, None, self._image.reshape(-1), "clip")
        return self._image

    def _deviation_of(self, x: Floats) -> Floats:
        """Return the deviation of each taxel that follows from an estimate, float32 (n,)."""
        blurred = self._blurred(np.maximum(x, 0)) / self._neighbours
        largest = float(blurred.max())
        if not largest > 0:
            return self._ones
        deviation: Floats = blurred / np.float32(largest) + np.float32(self._t.deviation_floor)
        return deviation

    def _blurred(self, x: Floats) -> Floats:
        blurred: Floats = self._blur[0] @ self._image_of(x) @ self._blur[1]
        return blurred.reshape(-1)[self._taxels]

    def _rows(self, x: Floats) -> Floats:
        rows = np.empty(self._projection.n_rows, dtype=np.float32)
        self._projection.whole(x, rows)
        return rows

    def _adjoint(self, rows: Floats) -> Floats:
        """Return W^T rows; the projection has it divided by L."""
        x = np.empty(self._taxels.size, dtype=np.float32)
        self._projection.whole_adjoint(rows, x)
        if self._projection.step_size != 1:
            x *= np.float32(1 / self._projection.step_size)
        return x


def _gaussian(n: int, length: float) -> Any:
    """Return the correlation of n places in a line, an (n, n) matrix; sparse if n is large."""
    if n <= MOST_DENSE:
        places = np.arange(n)
        distance = (places[:, None] - places) / length
        # Products with subnormal numbers take the processor forty times as long.
        return np.where(np.abs(distance) > REACH, 0, np.exp(-0.5 * distance**2)).astype(np.float32)
    from scipy import sparse  # here: most skins do not need it

    steps = range(-math.ceil(NEGLIGIBLE * length), math.ceil(NEGLIGIBLE * length) + 1)
    values = [np.full(n, math.exp(-0.5 * (step / length) ** 2), np.float32) for step in steps]
    return sparse.dia_array((np.array(values), list(steps)), shape=(n, n)).tocsr()


def _side_by_side(matrices: list[Any]) -> Any:
    """Return matrices of `_gaussian` beside each other."""
    if isinstance(matrices[0], np.ndarray):
        return np.hstack(matrices)
    from scipy import sparse  # here: most skins do not need it

    return sparse.hstack(matrices, format="csr")
