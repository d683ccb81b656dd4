"""Compiling of a solver's loops before its first frame."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

from .compiled import (
    COMPILING,
    ENVIRONMENT,
    NOT_INSTALLED,
    SOLVERS,
    check_fast,
    ready,
    use_compiled,
)


def compile_loops(solver: str, fast: str, log: Callable[[str], None]) -> None:
    """Compile the loops of a solver now, or read them from disk, so that no frame waits for it.

    Nothing is done for a solver without any, or where `use_compiled` is False, with Raises as
    there. `log` receives a line of text before anything is compiled (where nothing is on disk,
    before numba is imported), and one after it; where numba is not installed, one with the remedy.
    """
    if solver not in SOLVERS:
        return
    if check_fast(fast) == "off":
        if "off" not in (fast, os.environ.get(ENVIRONMENT)):
            log(NOT_INSTALLED)
        return
    begin_s = time.perf_counter()
    logged = not _cached()
    if logged:
        log(COMPILING)  # before numba is imported, which takes a second by itself
    if use_compiled(fast):
        from .kernels import LOOPS  # needs numba

        ready(*LOOPS[solver], log=log, begin_s=begin_s if logged else None)
    elif logged:
        log("compiled loops: numba cannot be imported; numpy is used")


def _cached() -> bool:
    """True if there are compiled loops on disk, up to date or not, where numba stores them."""
    cache_home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    stated = os.environ.get("NUMBA_CACHE_DIR")
    folders = (
        [stated] if stated else [f"{Path(__file__).parent}/__pycache__", f"{cache_home}/numba"]
    )
    pattern = "kernels.*.py{}{}*.nbi".format(*sys.version_info)
    return any(next(Path(folder).rglob(pattern), None) for folder in folders)
