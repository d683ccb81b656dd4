"""Array types that all nodes share."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Floats: TypeAlias = npt.NDArray[np.float32]
"""Frames, measurements and coefficients."""
Doubles: TypeAlias = npt.NDArray[np.float64]
"""Whatever is computed once, or in mechanics."""
Indices: TypeAlias = npt.NDArray[np.intp]
Mask: TypeAlias = npt.NDArray[np.bool_]
"""One bool a taxel (True where it exists, unless stated otherwise) or a measurement."""

TINY = 1e-30
"""Added to a divisor that can be 0, or the least of it: far below the squares of float32 forces
that differ from 0, so that no other quotient changes."""
