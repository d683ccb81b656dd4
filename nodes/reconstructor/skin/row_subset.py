"""What the default solver remembers of a row subset."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats, shared

from .rows import Rows


class RowSubset:
    """The last measurements of a row subset and their innovation, and Phi 1.

    Parameters
    ----------
    rows : Rows
        W, which reads this row subset now.

    Attributes
    ----------
    ones : ndarray of float32, shape (n_read,)
        Phi 1, in the order of the rows read.
    ones_energy : float
        Its squared length.
    y : ndarray of float32, shape (m,)
        The last measurements of this subset.
    innovation : ndarray of float32, shape (n_read,)
        Of its last frame.
    was_read : bool
        True if there was a frame of this subset; y and innovation are 0 else.
    """

    def __init__(self, rows: Rows, m: int) -> None:
        all_ones = np.ones(rows.n, dtype=np.float32)
        self.ones = shared(rows.forward(all_ones)[rows.read])
        self.ones_energy = float(self.ones @ self.ones)
        self.y = np.zeros(m, dtype=np.float32)
        self.innovation = np.zeros(len(self.ones), dtype=np.float32)
        self.was_read = False

    def keep(self, y: Floats, innovation: Floats) -> None:
        """Keep measurements and innovation of a frame."""
        self.y[:] = y
        self.innovation = innovation
        self.was_read = True
