"""Wires that a measurement matrix needs, by stated formulas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Indices, Mask

_CHUNK = 256
_OFF_GRID = np.array([0.31, 0.17])


@dataclass(frozen=True)
class Wiring:
    """Wires of a skin: those that leave it or end in an amplifier on it; places where two cross;
    length of all, in pitches; conversions from analog to digital a frame.
    """

    lines: int
    crossings: int
    length: float
    conversions: int


def star_wiring(groups: list[Indices], cells: Indices, n_cols: int, conversions: int) -> Wiring:
    """Wires of a skin whose taxels are summed in groups, by one amplifier a group.

    Each taxel has a wire of its own to the amplifier, which stands at the median row and column of
    its group, where the sum of the lengths is least. A wire runs along rows and columns, so that
    its length is |rows| + |columns|. Crossings are counted of straight wires: pairs of wires of
    different groups that cross. `groups`: numbers of the taxels of each; `cells`: cell of each
    taxel, intp (n,), row r and column c being r n_cols + c.
    """
    places = np.stack(np.divmod(cells, n_cols), axis=1).astype(np.float64)
    sizes = [len(group) for group in groups]
    a = places[np.concatenate(groups)]
    medians = np.repeat([np.median(places[group], axis=0) for group in groups], sizes, axis=0)
    # Not on a grid point, so that no wire runs through the begin of another.
    ends = medians + _OFF_GRID
    return Wiring(
        lines=len(a),
        crossings=count_crossings(a, ends, np.repeat(np.arange(len(groups)), sizes)),
        length=float(np.abs(a - medians).sum()),
        conversions=conversions,
    )


def sbhe_wiring(phi: SbhePhi, exists: Mask) -> Wiring:
    """Wires where each Hadamard block is a group of taxels, and its sums are made in analog: M
    conversions a frame.
    """
    ends = np.cumsum(phi.sizes)[:-1]
    groups = np.split(phi.permutation, ends)
    return star_wiring(groups, np.flatnonzero(exists), exists.shape[1], phi.m)


def array_wiring(n_rows: int, n_cols: int, conversions: int) -> Wiring:
    """Wires of a row-column array: a line along each row and each column.

    Length n_rows (n_cols - 1) + n_cols (n_rows - 1); each row crosses each column, which is where
    the taxel lies; all of them leave the skin.
    """
    length = float(n_rows * (n_cols - 1) + n_cols * (n_rows - 1))
    return Wiring(n_rows + n_cols, n_rows * n_cols, length, conversions)


def count_crossings(
    begins: npt.NDArray[np.float64], ends: npt.NDArray[np.float64], group_of: npt.NDArray[np.intp]
) -> int:
    """Number of pairs of straight lines of different groups that cross within both; (k, 2) and
    (k,).
    """
    total = 0
    for k in range(0, len(begins), _CHUNK):
        part = slice(k, k + _CHUNK)
        p, q, first = begins[part, None], ends[part, None], np.arange(k, k + len(begins[part]))
        of_both = (_side(p, q, begins) * _side(p, q, ends) < 0) & (
            _side(begins, ends, p) * _side(begins, ends, q) < 0
        )
        later = np.arange(len(begins)) > first[:, None]
        total += int((of_both & later & (group_of[part, None] != group_of)).sum())
    return total


def _side(
    p: npt.NDArray[np.float64], q: npt.NDArray[np.float64], r: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Sign of the side of the line p -> q on which r lies."""
    d, e = q - p, r - p
    sign: npt.NDArray[np.float64] = np.sign(d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0])
    return sign
