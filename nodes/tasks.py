"""Independent tasks of offline runs, computed by any concurrent.futures.Executor."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Hashable, Iterator, Mapping
from concurrent.futures import (
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    as_completed,
)
from contextlib import contextmanager
from typing import TypeVar

from .errors import SettingsError
from .lookup import did_you_mean, find_callable
from .process.control import watch_parent

K = TypeVar("K", bound=Hashable)
A = TypeVar("A")
R = TypeVar("R")

KINDS = ("process", "thread")
SERIAL = "serial"
FORMS = "serial, process:N, thread:N, or module:factory"
"""The texts that state an executor."""
MAX_WORKERS = 1024
SINGLE_THREADED = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Read by the numeric libraries when a worker starts: one core each."""


def make_executor(spec: str) -> Executor:
    """Make an executor, or raise SettingsError.

    `spec` is "process:N" or "thread:N", N workers on this host; or "module:factory", a user's
    callable that returns a `concurrent.futures.Executor`.
    """
    place = f"--executor {spec}"
    kind, _, argument = spec.partition(":")
    # A factory of the user's own has no number.
    is_misspelt = argument.isdecimal() and kind not in KINDS
    if not (kind and argument) or is_misspelt:
        raise SettingsError(f"{place}: expected {FORMS}{did_you_mean(kind, KINDS)}")

    if kind in KINDS:
        if not argument.isdecimal() or not 1 <= int(argument) <= MAX_WORKERS:
            raise SettingsError(f"{place}: expected 1..{MAX_WORKERS} workers")
        if kind == "thread":
            return ThreadPoolExecutor(int(argument))
        for threads in SINGLE_THREADED:
            os.environ.setdefault(threads, "1")
        # Spawned: a forked worker would inherit locks held by threads of this process.
        spawning = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(int(argument), mp_context=spawning)

    make = find_callable(spec, SettingsError)
    try:
        executor = make()
    except Exception as error:
        raise SettingsError(f"{place}: {type(error).__name__}: {error}") from error
    if not isinstance(executor, Executor):
        raise SettingsError(
            f"{place}: made {type(executor).__name__}, "
            "expected a concurrent.futures.Executor"
        )
    return executor


def computed(
    executor_name: str, function: Callable[[A], R], tasks: Mapping[K, A]
) -> Generator[tuple[K, Future[R]], None, None]:
    """Yield the key and the finished future of each task, in the order in which they finish.

    `function`, at the top of a module, so that a worker finds it by name, takes one task. If the
    caller stops, by an exception or Ctrl-C, the tasks that are left are cancelled and worker
    processes of this host are ended. They end with this process, too, however it ends.
    Of the executor "serial" this thread computes them, one after the other. Raises SettingsError as
    `make_executor`.
    """
    if not tasks:
        return
    if executor_name == SERIAL:
        # In this thread, which a signal interrupts at once: another one would go on.
        for key, task in tasks.items():
            yield key, _finished(function, task)
        return
    # Whoever calls may have children of its own, which are left alone.
    children_before = set(multiprocessing.active_children())
    executor = make_executor(executor_name)
    try:
        # Ctrl-C reaches the workers too; they inherit that they ignore it.
        with _interrupts_ignored():
            futures = {
                executor.submit(_run, function, task): key
                for key, task in tasks.items()
            }
        for future in as_completed(futures):
            yield futures[future], future
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        for worker in set(multiprocessing.active_children()) - children_before:
            worker.terminate()
        raise
    executor.shutdown()


def _finished(function: Callable[[A], R], task: A) -> Future[R]:
    """The finished future of a task that is computed here."""
    future: Future[R] = Future()
    try:
        future.set_result(function(task))
    except Exception as error:
        future.set_exception(error)
    return future


def _run(function: Callable[[A], R], task: A) -> R:
    """Compute one task, in a worker, which ends with the process that started it, or here."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        # It may have ended before this, the first task.
        assert parent.pid is not None
        watch_parent(parent.pid)
    return function(task)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    # Python lets the main thread alone change what a signal does.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
