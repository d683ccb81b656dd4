"""Motion of the forces between two frames, by regression on the measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from .tuning import SkinTuning


class MotionSums(NamedTuple):
    """Sums over the rows read, of three terms: the last estimate x, and its slopes along rows and
    columns.
    """

    gram: Sequence[Sequence[float]]  # products of the terms, (3, 3)
    products: Sequence[float]  # of each term and what the values exceed W x by
    energy: float  # sum of squares of x
    largest: float  # largest force of x
    n_read: int  # rows read
    n: int  # taxels


class Motion(NamedTuple):
    """The prediction x_p = (1 + growth) x + down dx/drow + across dx/dcol, within 0 to bound."""

    growth: float
    down: float
    across: float
    bound: float


def motion_of(sums: MotionSums, noise: float, error2: float, tuning: SkinTuning) -> Motion:
    """Return the motion of a frame, by ridge least squares scaled by what it explains.

    noise is the variance of a measurement, error2 the mean squared error of the last estimate.
    """
    gram = [list(row) for row in sums.gram]

    # Forces of which these rows see no more than noise or error, they do not contradict.
    seen = gram[0][0]
    unseen = max(sums.energy * sums.n_read / sums.n - seen, 0.0)
    doubt = max(noise, error2)
    gram[0][0] = seen + unseen * doubt / (doubt + seen / sums.n_read)

    ridge = tuning.ridge**2 * gram[0][0] + noise
    for k in range(3):
        gram[k][k] = (1 + tuning.ridge) * gram[k][k] + ridge
    growth, down, across = solved(gram, sums.products)

    # Three parameters explain a part of the noise, too.
    terms = zip((growth, down, across), sums.products, strict=True)
    explained = max(sum(weight * product for weight, product in terms), 0.0)
    part = explained / (explained + tuning.motion * noise)
    if sums.n_read < tuning.least_read:
        part = 0.0

    # What these rows hardly observe must not grow without bound, and frame after frame.
    growth = min(growth * part, 1.0)
    bound = sums.largest * max(1 + growth, 1.0)
    return Motion(growth, down * part, across * part, bound)


def solved(matrix: list[list[float]], right: Sequence[float]) -> list[float]:
    """Solve a small system of equations by elimination; the matrix is overwritten."""
    n = len(right)
    solution = list(right)
    for j in range(n):
        for k in range(j + 1, n):
            factor = matrix[k][j] / matrix[j][j]
            matrix[k] = [matrix[k][i] - factor * matrix[j][i] for i in range(n)]
            solution[k] = solution[k] - factor * solution[j]

    for j in reversed(range(n)):
        rest = sum(matrix[j][k] * solution[k] for k in range(j + 1, n))
        solution[j] = (solution[j] - rest) / matrix[j][j]
    return solution
