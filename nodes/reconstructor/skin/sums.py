"""Numbers that the vectors of a frame give to the decisions of the default solver."""

from __future__ import annotations

from typing import NamedTuple


class Read(NamedTuple):
    """Squared lengths and products of vectors at the begin of a frame.

    Attributes
    ----------
    power, changed2, second2
        Of the measurements; of their change, and of the change of that, as `NoiseLevel.changes`.
    e2, along, correction2
        Of the innovation; its product with the last correction; of that, in the rows read.
    change2
        Of the change of rows since they were read last, 0 where the frame remembers none.
    """

    power: float
    changed2: float
    second2: float
    e2: float
    along: float
    correction2: float
    change2: float


class Tested(NamedTuple):
    """Sums of an estimate x: of x^2, of taxels with x > 0, and (Phi 1)^T (y - Phi x)."""

    x2: float
    n_touched: float
    left: float
