"""Compiled loops, where numba is installed: whether they are used, and how they are compiled."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeVar

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean, one_line

FAST = ("auto", "on", "off")
#: Environment variable that says what "auto" means: "off" for numpy alone.
ENVIRONMENT = "SPARSESKIN_FAST"

#: Solvers that have compiled loops.
SOLVERS = ("skin", "fista")
#: Their tables hold places in 16 bits, which take half the room in the cache; larger skins are
#: left to numpy.
MAX_PLACES = 2**16
#: What is not worth a line.
TOLD_S = 2.0

Function = TypeVar("Function", bound=Callable[..., Any])


def check_fast(fast: str) -> str:
    """Return "on", "off", or "auto" where numba is to be used if it can be.

    Parameters
    ----------
    fast : str
        "auto": where numba is installed, unless the environment says SPARSESKIN_FAST=off.
        "on": always. "off": never.

    Raises
    ------
    SettingsError
        If it is another word, in the environment too, or "on" without numba.
    """
    name = "fast"
    if fast == "auto" and ENVIRONMENT in os.environ:
        name, fast = ENVIRONMENT, os.environ[ENVIRONMENT]
    if fast not in FAST:
        raise SettingsError(
            f"{name}: {fast!r} is not known{did_you_mean(fast, FAST)}; allowed: {', '.join(FAST)}"
        )
    installed = fast == "off" or find_spec("numba") is not None
    if fast == "on" and not installed:
        raise SettingsError(f"{name}: 'on' needs numba: pip install 'sparseskin[fast]'")
    return fast if installed else "off"


def use_compiled(fast: str) -> bool:
    """Return whether compiled loops are to be used; numba is then imported.

    Parameters
    ----------
    fast : str
        As in `check_fast`.

    Raises
    ------
    SettingsError
        As in `check_fast`, or if it is "on" and numba cannot be imported: it does not go with
        every numpy.
    """
    checked = check_fast(fast)
    if checked == "off":
        return False
    try:
        import_module("numba")
    except ImportError as error:
        if checked == "on":
            raise SettingsError(f"fast: importing numba failed: {one_line(error)}") from error
        return False
    return True


def compile_loops(solver: str, fast: str, log: Callable[[str], None]) -> None:
    """Compile a solver's loops now, or read them from disk, so that no frame waits for it.

    Parameters
    ----------
    solver : str
        Name of a solver; one without compiled loops has nothing to wait for.
    fast : str
        As in `check_fast`, with the Raises of `use_compiled`; nothing is done where that says no.
    log : callable
        Takes a line of text, where it has taken more than 2 s.
    """
    begin_s = time.perf_counter()
    if solver not in SOLVERS or not use_compiled(fast):
        return
    kernels = import_module("sparseskin.nodes.fast_kernels")
    ready(*kernels.LOOPS[solver])
    took_s = time.perf_counter() - begin_s
    if took_s > TOLD_S:
        log(f"compiled loops: ready after {took_s:.0f} s")


def ready(*loops: Callable[..., Any]) -> None:
    """Compile loops for their types, or read them from disk; from then on they take no others."""
    for loop in loops:
        if not loop.signatures:  # type: ignore[attr-defined]
            for signature in _SIGNATURES[loop]:
                loop.compile(signature)  # type: ignore[attr-defined]
            loop.disable_compile()  # type: ignore[attr-defined]


_SIGNATURES: dict[Callable[..., Any], tuple[str, ...]] = {}


def compiled(*signatures: str, sums_in_any_order: bool = False) -> Callable[[Function], Function]:
    """Return the decorator that makes a loop, to be compiled by `ready` for these signatures.

    It is kept on disk: beside the module, where that folder can be written to, or else in the
    user's cache folder, or in NUMBA_CACHE_DIR where it is set. With none of these it is compiled
    anew in each process.

    Parameters
    ----------
    *signatures : str
        As numba writes them, "void(float32[::1], int64)". None: for use within compiled
        functions of the same file.
    sums_in_any_order : bool
        Whether a sum over a vector may be taken in the order that is quickest: on one machine
        always the same, and the same bits. All else is rounded as it is written.
    """
    numba = import_module("numba")

    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    if sums_in_any_order:
        options["fastmath"] = {"reassoc"}

    def decorate(function: Function) -> Function:
        made: Function
        try:
            made = numba.njit(cache=bool(signatures), **options)(function)
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise
            made = numba.njit(**options)(function)
        if signatures:
            _SIGNATURES[made] = signatures
        return made

    return decorate
