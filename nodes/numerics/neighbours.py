"""Each cell of a grid and its eight neighbours, combined."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


def of_nine(field: npt.NDArray[Any], combine: np.ufunc) -> npt.NDArray[Any]:
    """Each cell and its eight neighbours, combined: an array as `field`, (n_rows, n_cols); beyond
    the edge is 0.
    """
    padded = np.pad(field, 1)
    rows = combine(combine(padded[:-2], padded[1:-1]), padded[2:])
    found: npt.NDArray[Any] = combine(combine(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])
    return found
