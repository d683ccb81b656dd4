"""Array types that messages and nodes share."""

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

AnyArray: TypeAlias = npt.NDArray[Any]
Floats: TypeAlias = npt.NDArray[np.float32]
"""Frames, measurements and coefficients."""
Doubles: TypeAlias = npt.NDArray[np.float64]
"""Whatever is computed once, or in mechanics."""
Indices: TypeAlias = npt.NDArray[np.intp]
Integers: TypeAlias = npt.NDArray[np.int32]
"""Numbers of regions, of rows of points, and codes of quantised numbers."""
Bytes: TypeAlias = npt.NDArray[np.uint8]
Mask: TypeAlias = npt.NDArray[np.bool_]
"""One bool a taxel (True where it exists, unless stated otherwise) or a measurement."""
