"""Executors of independent tasks: any concurrent.futures.Executor, stated as a text."""

import os
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean, find_callable

KINDS = ("process", "thread")
FORMS = "serial, process:N, thread:N, or module:factory"
"""The texts that state an executor."""
MAX_WORKERS = 1024
SINGLE_THREADED = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Read by the numeric libraries when a worker starts: one core each."""


def make_executor(spec: str) -> Executor:
    """Make an executor, or raise SettingsError.

    `spec` is "serial", one task after the other; "process:N" or "thread:N", N workers on this host;
    "module:factory", a user's callable that returns a `concurrent.futures.Executor`.
    """
    if spec == "serial":
        return ThreadPoolExecutor(1)
    kind, colon, rest = spec.partition(":")
    if not (kind and colon and rest) or (rest.isdecimal() and kind not in KINDS):
        raise SettingsError(f"--executor {spec}: expected {FORMS}{did_you_mean(kind, KINDS)}")
    if kind in KINDS:
        if not rest.isdecimal() or not 1 <= int(rest) <= MAX_WORKERS:
            raise SettingsError(f"--executor {spec}: expected 1..{MAX_WORKERS} workers")
        if kind == "thread":
            return ThreadPoolExecutor(int(rest))
        for threads in SINGLE_THREADED:
            os.environ.setdefault(threads, "1")
        # Spawned: a forked worker would inherit locks held by threads of this process.
        return ProcessPoolExecutor(int(rest), mp_context=get_context("spawn"))
    make = find_callable(spec, SettingsError)
    try:
        made = make()
    except Exception as error:
        raise SettingsError(f"--executor {spec}: {type(error).__name__}: {error}") from error
    if not isinstance(made, Executor):
        raise SettingsError(
            f"--executor {spec}: made {type(made).__name__}, expected a concurrent.futures.Executor"
        )
    return made
