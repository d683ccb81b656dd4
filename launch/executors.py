"""Where independent tasks run: any concurrent.futures.Executor, chosen by a text."""

from __future__ import annotations

import os
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean, find_callable

KINDS = ("process", "thread")
FORMS = "serial, process:N, thread:N or module:factory"
MAX_WORKERS = 1024


def make_executor(spec: str) -> Executor:
    """Make an executor.

    Parameters
    ----------
    spec : str
        "serial", one task after the other; "process:N" or "thread:N", N workers on this host;
        or "module:factory", a callable of the user's that returns a
        `concurrent.futures.Executor`.

    Raises
    ------
    SettingsError
        If the text has none of these forms, or the factory is not there, fails or makes
        something else.
    """
    if spec == "serial":
        return ThreadPoolExecutor(1)
    kind, colon, rest = spec.partition(":")
    if not (kind and colon and rest):
        raise SettingsError(f"--executor {spec}: expected {FORMS}{did_you_mean(kind, KINDS)}")
    if kind in KINDS:
        if not rest.isdecimal() or not 1 <= int(rest) <= MAX_WORKERS:
            raise SettingsError(f"--executor {spec}: expected 1..{MAX_WORKERS} workers")
        if kind == "thread":
            return ThreadPoolExecutor(int(rest))
        # Read by the numeric libraries when a worker starts: a core each, and no more.
        for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            os.environ.setdefault(threads, "1")
        # Spawned, not forked: a fork would share what threads of this process hold.
        return ProcessPoolExecutor(int(rest), mp_context=get_context("spawn"))
    if rest.isdecimal():
        raise SettingsError(f"--executor {spec}: expected {FORMS}{did_you_mean(kind, KINDS)}")
    factory = find_callable(spec, SettingsError)
    try:
        made = factory()
    except Exception as error:
        raise SettingsError(f"--executor {spec}: {type(error).__name__}: {error}") from error
    if not isinstance(made, Executor):
        raise SettingsError(
            f"--executor {spec}: made {type(made).__name__}, expected a concurrent.futures.Executor"
        )
    return made
