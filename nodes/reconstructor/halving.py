"""Repeated halving of a grid by sums and differences of neighbours: the inside of Haar."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Call, Floats, Indices

Number = TypeVar("Number", bound=np.generic)

_ONE_PLUS_I = np.array(1 + 1j, dtype=np.complex64)
_ONE_MINUS_I = np.array(1 - 1j, dtype=np.complex64)


@dataclass(frozen=True, eq=False)
class Bands:
    """What stands at each place of a coefficient buffer.

    Attributes
    ----------
    cells : ndarray of intp, shape (n_inner,)
        Flat cell of the pyramid; -1 for a place that holds no coefficient.
    energies : ndarray of float64, shape (n_inner,)
        Squared length of the coefficient's row.
    """

    cells: Indices
    energies: npt.NDArray[np.float64]


class Halvings:
    """Halve a grid along each side of more than 1, as long as these are even; nothing scaled.

    Samples are kept in an order in which partners along the rows' axis stand half a buffer
    apart, at every level, and partners along the columns' axis are neighbours, taken as one
    complex number: (a + ib)(1 + i) = (a - b) + i(a + b). So numpy does a level of thousands of
    samples in three calls on evenly spaced numbers, which is where it is quick.

    A coefficient buffer holds the levels one after the other. In a level's part, the samples
    that went on to the next level leave places that hold no coefficient.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the grid.

    Attributes
    ----------
    shapes : list of tuple of int
        The grid at each level; the last is what could not be halved.
    depth : int
        Number of halvings.
    order : ndarray of intp, shape (n,)
        Place p of the sample buffer holds the sample order[p] of the flat grid.
    n_inner : int
        Length of a coefficient buffer; 0 with depth 0.
    last_places : ndarray of intp, shape (n_last,)
        Where in the coefficient buffer the last grid's samples are, row by row.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shapes = [shape]
        while (halved := _halved(self.shapes[-1])) is not None:
            self.shapes.append(halved)
        self.depth = len(self.shapes) - 1
        self._orders = self._orders_of_levels()
        self.order = self._orders[0]
        self._starts = [0]
        for rows, cols in self.shapes[:-1]:
            self._starts.append(self._starts[-1] + rows * cols)
        self.n_inner = self._starts[-1]
        self.last_places: Indices = np.arange(0)
        if self.depth:
            self.last_places = self._passed_on(np.arange(self.n_inner), self.depth - 1)

    def analysis(self, x: Floats, c: Floats) -> list[Call]:
        """Return the calls that turn samples x, shape (n,), into coefficients c, (n_inner,)."""
        calls: list[Call] = []
        source = x
        for level in range(self.depth):
            part = c[self._starts[level] : self._starts[level + 1]]
            half = part.size // 2
            low, high = source[:half], source[half:]
            calls.append((np.add, (low, high, part[:half])))
            calls.append((np.subtract, (low, high, part[half:])))
            if self._both_axes(level):
                pairs = part.view(np.complex64)
                calls.append((np.multiply, (pairs, _ONE_PLUS_I, pairs)))
            source = self._passed_on(c, level)
        return calls

    def synthesis(self, c: Floats, x: Floats) -> list[Call]:
        """Return the calls of the transposed transform: coefficients c, overwritten, to x."""
        calls: list[Call] = []
        for level in reversed(range(self.depth)):
            part = c[self._starts[level] : self._starts[level + 1]]
            half = part.size // 2
            if self._both_axes(level):
                # (d + is)(1 - i) = (s + d) + i(s - d)
                pairs = part.view(np.complex64)
                calls.append((np.multiply, (pairs, _ONE_MINUS_I, pairs)))
            target = self._passed_on(c, level - 1) if level else x
            calls.append((np.add, (part[:half], part[half:], target[:half])))
            calls.append((np.subtract, (part[:half], part[half:], target[half:])))
        return calls

    def last(self, c: Floats) -> Floats:
        """Return the view of a coefficient buffer at `last_places`."""
        return self._passed_on(c, self.depth - 1)

    def bands(
        self,
        true_shape: tuple[int, int],
        energy: npt.NDArray[np.float64],
        width: int,
    ) -> Bands:
        """Return where in the pyramid each coefficient belongs, and its squared length.

        Parameters
        ----------
        true_shape : tuple of int
            Rows and columns of the grid that are no padding.
        energy : ndarray of float64, shape of the grid
            Squared weight of each sample; 0 for padding.
        width : int
            Columns of the whole pyramid, in whose top left corner this one stands.
        """
        cells = np.full(self.n_inner, -1, dtype=np.intp)
        energies = np.zeros(self.n_inner)
        rows, cols = true_shape
        for level in range(self.depth):
            (big_r, big_c), (small_r, small_c) = self.shapes[level], self.shapes[level + 1]
            r, c = big_r // small_r, big_c // small_c
            energy = energy.reshape(small_r, r, small_c, c).sum(axis=(1, 3))
            order = self._orders[level + 1]
            i, j = np.divmod(order, small_c)
            # Approximations of a side: its pairs and the unpaired sample; details: its pairs.
            sums_r, sums_c = -(-rows // r), -(-cols // c)
            part = slice(self._starts[level], self._starts[level + 1])
            energies[part] = self._in_part(level, {b: energy.reshape(-1)[order] for b in _BANDS})
            of_band: dict[tuple[int, int], Indices] = {}
            for down, right in _BANDS:
                inside = (i < (rows - sums_r if down else sums_r)) & (
                    j < (cols - sums_c if right else sums_c)
                )
                cell = (i + down * sums_r) * width + j + right * sums_c
                passed_on = not down and not right and level < self.depth - 1
                of_band[down, right] = np.where(inside & (not passed_on), cell, -1)
            cells[part] = self._in_part(level, of_band)
            rows, cols = sums_r, sums_c
        return Bands(cells, energies)

    def _both_axes(self, level: int) -> bool:
        rows, cols = self.shapes[level]
        return rows > 1 and cols > 1

    def _passed_on(self, c: npt.NDArray[Number], level: int) -> npt.NDArray[Number]:
        """Return the view of what a level of a coefficient buffer passes on to the next."""
        start, stop = self._starts[level], self._starts[level + 1]
        first_half = c[start : start + (stop - start) // 2]
        return first_half[1::2] if self._both_axes(level) else first_half

    def _in_part(
        self, level: int, of_band: Mapping[tuple[int, int], npt.NDArray[Number]]
    ) -> npt.NDArray[Number]:
        """Return the bands (down, right) as they stand in a level's part of the buffer."""
        rows, _ = self.shapes[level]
        if self._both_axes(level):
            halves = [np.stack([of_band[down, 1], of_band[down, 0]], axis=1) for down in (0, 1)]
            return np.concatenate(halves).ravel()
        return np.concatenate([of_band[0, 0], of_band[1, 0] if rows > 1 else of_band[0, 1]])

    def _orders_of_levels(self) -> list[Indices]:
        """Return the order of the samples in their buffer, for each level."""
        rows, cols = self.shapes[-1]
        orders: list[Indices] = [np.arange(rows * cols, dtype=np.intp)]
        # From the last level up: a sample (i, j) is split into its 2 or 4 parts.
        for big, small in zip(self.shapes[-2::-1], self.shapes[:0:-1], strict=True):
            i, j = np.divmod(orders[0], small[1])
            r, c = big[0] // small[0], big[1] // small[1]
            if r == c == 2:
                halves = [
                    np.stack([(2 * i + down) * big[1] + 2 * j + right for right in (0, 1)], axis=1)
                    for down in (0, 1)
                ]
                orders.insert(0, np.concatenate(halves).ravel())
            elif r == 2:
                orders.insert(0, np.concatenate([(2 * i + down) * big[1] + j for down in (0, 1)]))
            else:
                orders.insert(0, np.concatenate([i * big[1] + 2 * j + k for k in (0, 1)]))
        return orders


_BANDS = ((0, 0), (0, 1), (1, 0), (1, 1))


def _halved(shape: tuple[int, int]) -> tuple[int, int] | None:
    rows, cols = shape
    if rows * cols == 1 or any(side > 1 and side % 2 for side in shape):
        return None
    return max(rows // 2, 1), max(cols // 2, 1)
