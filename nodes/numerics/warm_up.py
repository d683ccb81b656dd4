"""Compiling of a solver's loops before its first frame."""

from __future__ import annotations

import os
from collections.abc import Callable

from .compiled import (
    ENVIRONMENT,
    NOT_IMPORTED,
    NOT_INSTALLED,
    SOLVERS,
    check_fast,
    ready,
    use_compiled,
)


def compile_loops(
    solver: str, fast: str, log: Callable[[str], None], contacts: bool = False
) -> None:
    """Compile the loops of a solver now, or read them from disk, so that no frame waits for it;
    with `contacts` that of contacts, too.

    Nothing is done where there are none, or where `use_compiled` is False, with Raises as
    there. `log` receives a line of text before anything is compiled, and one after it; where numba
    is missing or cannot be imported, one that says so.
    """
    if solver not in SOLVERS and not contacts:
        return
    if use_compiled(fast):
        from .kernels import LOOPS, components  # needs numba

        ready(*LOOPS.get(solver, ()), *[components] * contacts, log=log)
    elif "off" not in (fast, os.environ.get(ENVIRONMENT)):
        log(NOT_INSTALLED if check_fast(fast) == "off" else NOT_IMPORTED)
