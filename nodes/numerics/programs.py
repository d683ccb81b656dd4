"""Programs of numpy calls: prepared once, run for each frame without slicing or allocating.

A transform of a few thousand numbers is a hundred small numpy calls, and slicing their views
takes as long as the arithmetic. So the views are made once, together with the buffers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from sparseskin.nodes.numerics.arrays import Floats, Indices

Call: TypeAlias = tuple[Callable[..., Any], tuple[Any, ...]]


def run(program: Sequence[Call]) -> None:
    """Execute the calls of a program, in order."""
    for function, arguments in program:
        function(*arguments)


def gather(source: Floats, indices: Indices, out: Floats) -> Call:
    """Return the call `out[i] = source[indices[i]]`.

    mode="clip" saves numpy's safety copy of `out`; no index is out of range.
    """
    return (source.take, (indices, None, out, "clip"))
