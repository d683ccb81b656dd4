"""Fewer, larger taxels: the sums of neighbours in place of the taxels of a skin."""

from __future__ import annotations

import math
import time

import numpy as np
from scipy import ndimage

from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask
from sparseskin.studies.evaluate import VALUE_BYTES, Solved

STEPS = 5
"""Steps of the interpolation. Chosen: on five recordings, 10 or 30 change the error by 0.5 % of it
at most."""


def neighbours(mask: Mask, m: int) -> Indices:
    """Split the taxels of a grid into m groups of neighbours, of sizes that differ by at most 1.

    The grid is cut into bands of rows, about as high as a group is wide; a path leads through each
    band column by column, and back through the next one. Groups are equal parts of this path: of
    N = 4 m taxels on a grid of even sides, squares of 2 x 2.

    Parameters
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    m : int
        Number of groups, 1 to the number of taxels.

    Returns
    -------
    ndarray of intp, shape (N,)
        Number of the group of each taxel, 0..m - 1, taxels row by row.
    """
    rows, cols = np.nonzero(mask)
    n_rows, n_cols = mask.shape
    n_bands = max(1, round(math.sqrt(m * n_rows / n_cols)))
    band = rows * min(n_bands, n_rows) // n_rows
    # Back through every second band.
    along = np.where(band % 2, -cols, cols)
    path = np.lexsort((rows, along, band))

    groups = np.empty(rows.size, dtype=np.intp)
    groups[path] = np.arange(rows.size) * m // rows.size
    return groups


class LargerTaxels:
    """Estimator of a skin of fewer, larger taxels, each of which reads the sum of its neighbours.

    Forces are smooth, and their sum over each group is kept. Readings are those of the small
    taxels, noise included: a larger taxel averages it.

    Parameters
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    m : int
        Number of larger taxels, 1 to the number of taxels.

    Notes
    -----
    Interpolation that keeps the sums of areas: Tobler, J. Am. Stat. Assoc. 74, 519 (1979), with the
    mean of 3 x 3 taxels.
    """

    def __init__(self, mask: Mask, m: int) -> None:
        self._mask = mask
        self.n_values = m
        self.groups = neighbours(mask, m)
        self.sizes = np.bincount(self.groups)
        self._n_near = _mean_of_near(mask.astype(np.float64))[mask]

    def sums(self, taxels: Floats) -> Floats:
        """Readings of the larger taxels: float32 (m,), newtons, of (n_rows, n_cols) taxels."""
        sums = np.bincount(self.groups, taxels[self._mask], self.n_values)
        return sums.astype(np.float32)

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`; the time is that of the interpolation."""
        sums = self.sums(taxels)
        begin_s = time.perf_counter()
        cpu_begin_s = time.thread_time()
        forces = self.spread(sums)
        return Solved(
            forces,
            wall_s=time.perf_counter() - begin_s,
            cpu_s=time.thread_time() - cpu_begin_s,
            n_steps=STEPS,
            n_bytes=VALUE_BYTES * self.n_values,
        )

    def spread(self, sums: Floats) -> Floats:
        """Forces of the small taxels, float32 (n_rows, n_cols), of `sums` of the groups, (m,)."""
        mask = self._mask
        groups = self.groups
        sums_of_groups = np.maximum(sums, 0).astype(np.float64)
        image = np.zeros(mask.shape)
        image[mask] = (sums_of_groups / self.sizes)[groups]
        for _ in range(STEPS):
            # The mean of neighbours, and then in each group what it lacks in the sum.
            smooth = _mean_of_near(image)[mask] / self._n_near
            missing = (sums_of_groups - np.bincount(groups, smooth)) / self.sizes
            forces = np.maximum(smooth + missing[groups], 0)

            # Negative forces were cut off: the others are scaled.
            totals = np.maximum(np.bincount(groups, forces), 1e-30)
            image[mask] = forces * (sums_of_groups / totals)[groups]
        return image.astype(np.float32)


def _mean_of_near(image: Doubles) -> Doubles:
    """Mean of 3 x 3 taxels, 0 beyond the edges."""
    mean: Doubles = ndimage.uniform_filter(image, 3, mode="constant")
    return mean
