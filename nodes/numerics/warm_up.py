"""Compiling of all loops before the first frame: `python -m sparseskin.nodes.numerics.warm_up` does
it at installation.
"""

from __future__ import annotations

import os
from collections.abc import Callable

from . import compiled


def compile_loops(
    fast: str, log: Callable[[str], None], count: compiled.Count = lambda done, of: None
) -> None:
    """Compile all loops now, or read them from disk, so that no frame waits for it.

    Nothing is done where `use_compiled` is False, with Raises as there. `log` receives a line of
    text before anything is compiled, and one after it; where numba is missing or cannot be
    imported, one that says so. `count` receives the numbers of loops that are compiled and of all,
    from 0 on, if any has to be.
    """
    if compiled.use_compiled(fast):
        from . import kernels  # needs numba

        compiled.ready(*kernels.LOOPS, log=log, count=count)
    elif "off" not in (fast, os.environ.get(compiled.ENVIRONMENT)):
        is_missing = compiled.check_fast(fast) == "off"
        log(compiled.NOT_INSTALLED if is_missing else compiled.NOT_IMPORTED)


if __name__ == "__main__":
    compile_loops("auto", print)
