"""Checks of what a solver is told, with one message for all of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sparseskin.nodes.errors import SolverError

MAX_ITERATIONS = 1000


def whole_number(solver: str, name: str, value: Any, low: int, high: int) -> int:
    """Return an integer in low..high.

    Raises
    ------
    SolverError
        If it is anything else.
    """
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or not low <= value <= high:
        raise SolverError(
            f"{solver}: {name} = {value!r} is not allowed; allowed: an integer {low}..{high}"
        )
    return int(value)


def newtons(solver: str, name: str, value: Any) -> float:
    """Return a finite number of newtons, 0 or more.

    Raises
    ------
    SolverError
        If it is anything else.
    """
    real = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    if not real or not 0 <= value < math.inf:
        raise SolverError(
            f"{solver}: {name} = {value!r} is not allowed; allowed: a finite number of newtons, "
            "0 or more"
        )
    return float(value)
