"""Programs of numpy calls: prepared once, run per frame without slicing or allocating.

A transform of a few thousand numbers is a hundred small numpy calls, and cutting the views
they work on costs as much as the arithmetic. So the views are cut once, when the buffers are
made, and a frame only walks down the list.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Floats: TypeAlias = npt.NDArray[np.float32]
Indices: TypeAlias = npt.NDArray[np.intp]
Call: TypeAlias = tuple[Callable[..., Any], tuple[Any, ...]]


def run(program: Sequence[Call]) -> None:
    """Make the calls of a program, in order."""
    for function, arguments in program:
        function(*arguments)


def gather(source: Floats, indices: Indices, out: Floats) -> Call:
    """Return the call `out[i] = source[indices[i]]`.

    mode="clip" keeps numpy from taking a safety copy of `out`; no index is out of range.
    """
    return (source.take, (indices, None, out, "clip"))
