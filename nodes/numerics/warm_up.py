"""Compiling of all loops before the first frame."""

from __future__ import annotations

import os
from collections.abc import Callable

from . import compiled


def compile_loops(
    solver: str, fast: str, log: Callable[[str], None], contacts: bool = False
) -> None:
    """Compile all loops now, or read them from disk, so that no frame waits for it.

    Nothing is done where the solver has none and there are no contacts, or where `use_compiled` is
    False, with Raises as there. `log` receives a line of text before anything is compiled, and one
    after it; where numba is missing or cannot be imported, one that says so.
    """
    if solver not in compiled.SOLVERS and not contacts:
        return
    if compiled.use_compiled(fast):
        from . import kernels  # needs numba

        compiled.ready(*kernels.LOOPS, log=log)
    elif "off" not in (fast, os.environ.get(compiled.ENVIRONMENT)):
        is_missing = compiled.check_fast(fast) == "off"
        log(compiled.NOT_INSTALLED if is_missing else compiled.NOT_IMPORTED)
