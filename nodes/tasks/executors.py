"""Executors of independent tasks: any concurrent.futures.Executor, stated as a text."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.extensions import EXECUTORS, load, loaded, offered
from sparseskin.nodes.lookup import did_you_mean, find_callable

KINDS = ("process", "thread")
MAX_WORKERS = 1024
SINGLE_THREADED = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Read by the numeric libraries when a worker starts: one core each."""


@dataclass(frozen=True)
class Factory:
    """A kind of executor that a plug-in brings.

    Attributes
    ----------
    forms : str
        The texts that state one, for help and errors; each begins with the kind and a colon.
    make : callable
        Makes the executor of such a text, or raises SettingsError.
    """

    forms: str
    make: Callable[[str], Executor]


def forms() -> str:
    """The texts that state an executor."""
    offers = [factory.forms for factory in loaded(EXECUTORS).values()]
    return ", ".join(["serial", "process:N", "thread:N", *offers, "or module:factory"])


def make_executor(spec: str) -> Executor:
    """Make an executor, or raise SettingsError.

    `spec` is "serial", one task after the other; "process:N" or "thread:N", N workers on this host;
    "module:factory", a user's callable that returns a `concurrent.futures.Executor`; or of a kind
    that a plug-in brings, as "dask:tcp://HOST:PORT".
    """
    if spec == "serial":
        return ThreadPoolExecutor(1)
    kind, colon, rest = spec.partition(":")
    if kind in offered(EXECUTORS):
        factory: Factory = load(EXECUTORS, kind, SettingsError, f"--executor {spec}")
        return factory.make(spec)
    if not (kind and colon and rest) or (rest.isdecimal() and kind not in KINDS):
        raise SettingsError(
            f"--executor {spec}: expected {forms()}"
            f"{did_you_mean(kind, (*KINDS, *offered(EXECUTORS)))}"
        )
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
