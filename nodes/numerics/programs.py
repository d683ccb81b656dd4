"""Programs of numpy calls: prepared once, run for each frame without slicing or allocating.

A transform of a few thousand numbers is a hundred small numpy calls, and slicing their views
takes as long as the arithmetic. So the views are made once, together with the buffers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

Call: TypeAlias = tuple[Callable[..., Any], tuple[Any, ...]]


def run(program: Sequence[Call]) -> None:
    """Execute the calls of a program, in order."""
    for function, arguments in program:
        function(*arguments)
