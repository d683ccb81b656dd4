"""Executor on a Dask cluster: one that is started for the run, or one that is there already."""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import warnings
from collections.abc import Callable
from concurrent.futures import Executor, Future
from importlib import import_module
from importlib.metadata import version
from typing import Any, TypeVar

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.tasks.executors import MAX_WORKERS, SINGLE_THREADED, Factory
from sparseskin.nodes.tasks.fingerprint import code_fingerprint

FORMS = "dask:local, dask:local:N, dask:tcp://HOST:PORT or dask:tls://HOST:PORT"
SCHEMES = ("tcp://", "tls://")
CONNECT_S = 10.0
"""Longest wait for the scheduler."""
WORKERS_S = 60.0
"""Longest wait for the first worker of a cluster, and for the answers of its workers."""
T = TypeVar("T")


class DaskExecutor(Executor):
    """Runs tasks on the workers of a Dask cluster.

    A task whose worker dies is run again by another one, so it must be one that may run twice.
    `shutdown` ends the connection, and the cluster if it was started for this executor.

    Parameters
    ----------
    client : distributed.Client
        Connected to the scheduler.
    cluster : distributed.LocalCluster, optional
        Cluster that ends with this executor.
    """

    def __init__(self, client: Any, cluster: Any = None) -> None:
        self._client, self._cluster = client, cluster
        # The same call twice is two tasks: what a task writes is part of its result.
        self._executor = client.get_executor(pure=False)

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        found: Future[T] = self._executor.submit(fn, *args, **kwargs)
        return found

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        # A scheduler that is gone cannot be told anything.
        with contextlib.suppress(Exception):
            self._executor.shutdown(wait=wait and not cancel_futures)
        with contextlib.suppress(Exception):
            self._client.close(timeout=CONNECT_S)
        if self._cluster is not None:
            with contextlib.suppress(Exception):
                self._cluster.close(timeout=CONNECT_S)


def make_dask_executor(spec: str) -> DaskExecutor:
    """Make the executor of "dask:local", "dask:local:N" or "dask:tcp://HOST:PORT" ("tls" as well).

    "local" starts N workers (by default one for each core) as processes of this host, of one thread
    each; only this process can reach them, by a certificate of this run. An address is that of a
    scheduler whose workers run the same code. Raises SettingsError if `spec` is none of these, the
    package is missing, no scheduler answers within 10 s, no worker has joined after 60 s, or a
    worker runs another version.
    """
    place = spec.partition(":")[2]
    n_workers = _workers_of(spec, place)
    try:
        distributed: Any = import_module("distributed")
    except ImportError as error:
        raise SettingsError(
            f"--executor {spec}: needs the package distributed; pip install 'sparseskin[scale]'"
        ) from error
    for name in ("distributed", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        # Versions are compared below, in one line.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if n_workers:
                return _started(distributed, spec, n_workers)
            client = distributed.Client(place, timeout=CONNECT_S, set_as_default=False)
    except SettingsError:
        raise
    except OSError as error:
        raise SettingsError(
            f"--executor {spec}: no Dask scheduler answers at {place} within {CONNECT_S:g} s"
        ) from error
    except Exception as error:
        raise SettingsError(f"--executor {spec}: {one_line(error)}") from error
    try:
        _check_versions(spec, client)
    except BaseException:
        client.close()
        raise
    return DaskExecutor(client)


def _workers_of(spec: str, place: str) -> int:
    """Number of workers to start; 0 for the address of a scheduler."""
    kind, colon, number = place.partition(":")
    if kind == "local":
        if not colon:
            return len(os.sched_getaffinity(0))
        if number.isascii() and number.isdecimal() and 1 <= int(number[:9]) <= MAX_WORKERS:
            return int(number)
        raise SettingsError(f"--executor {spec}: expected 1..{MAX_WORKERS} workers")
    if place.startswith(SCHEMES):
        host, colon, port = place.partition("://")[2].rpartition(":")
        if host and colon and port.isascii() and port.isdecimal() and 0 < int(port[:9]) < 65536:
            return 0
    raise SettingsError(f"--executor {spec}: expected {FORMS}")


def _started(distributed: Any, spec: str, n_workers: int) -> DaskExecutor:
    """Start a cluster of this host.

    Without keys any user of this host could have code run by its scheduler.
    """
    for name in SINGLE_THREADED:
        os.environ.setdefault(name, "1")
    try:
        security = distributed.Security.temporary()
    except ImportError as error:
        raise SettingsError(
            f"--executor {spec}: needs the package cryptography; pip install 'sparseskin[scale]'"
        ) from error
    cluster = distributed.LocalCluster(
        n_workers=n_workers,
        threads_per_worker=1,
        processes=True,
        memory_limit=0,
        dashboard_address=None,
        worker_dashboard_address=None,
        security=security,
        protocol="tls://",
        host="127.0.0.1",
        silence_logs=logging.CRITICAL,
    )
    try:
        client = distributed.Client(cluster, timeout=CONNECT_S, set_as_default=False)
    except BaseException:
        cluster.close()
        raise
    return DaskExecutor(client, cluster)


def versions_here() -> dict[str, str]:
    """Versions that client and workers must share: of Python without its last number, of
    distributed, and of sparseskin with the fingerprint of its code.
    """
    python = ".".join(platform.python_version_tuple()[:2])
    own = f"{version('sparseskin')} ({code_fingerprint()})"
    return {"Python": python, "distributed": version("distributed"), "sparseskin": own}


def _check_versions(spec: str, client: Any) -> None:
    """Check that there are workers, and that each runs what this process runs."""
    try:
        client.wait_for_workers(1, timeout=WORKERS_S)
    except TimeoutError as error:
        raise SettingsError(
            f"--executor {spec}: no worker has joined the scheduler after {WORKERS_S:g} s"
        ) from error
    here = versions_here()
    try:
        found = client.run(versions_here, on_error="return")
    except Exception as error:
        raise SettingsError(f"--executor {spec}: {one_line(error)}") from error
    for address, versions in sorted(found.items()):
        if not isinstance(versions, dict):
            what = one_line(versions) if isinstance(versions, BaseException) else "no answer"
            raise SettingsError(f"--executor {spec}: worker {address}: {what}")
        for name, own in here.items():
            other = str(versions.get(name))[:80]
            if other != own:
                raise SettingsError(
                    f"--executor {spec}: worker {address} runs {name} {other}, this process {own}; "
                    "install the same on both"
                )


DASK = Factory(FORMS, make_dask_executor)
