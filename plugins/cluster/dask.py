"""Executor on a Dask cluster."""

from __future__ import annotations

import contextlib
import logging
import platform
import sys
import warnings
from collections.abc import Callable
from concurrent.futures import Executor, Future
from importlib import import_module
from importlib.metadata import version
from typing import Any, TypeVar

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.tasks.executors import Factory
from sparseskin.nodes.tasks.fingerprint import code_fingerprint

FORMS = "dask:tcp://HOST:PORT or dask:tls://HOST:PORT"
SCHEMES = ("tcp://", "tls://")
CONNECT_S = 10.0
"""Longest wait for the scheduler."""
WORKERS_S = 60.0
"""Longest wait for the first worker of a cluster, and for the answers of its workers."""
T = TypeVar("T")


class DaskExecutor(Executor):
    """Runs tasks on the workers of a Dask cluster.

    A task whose worker dies is run again by another one, so it must be one that may run twice.
    `shutdown` ends the connection.

    Parameters
    ----------
    client : distributed.Client
        Connected to the scheduler.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
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


def make_dask_executor(spec: str) -> DaskExecutor:
    """Make the executor of "dask:tcp://HOST:PORT" ("tls" as well), the address of a scheduler whose
    workers run the same code. Raises SettingsError if `spec` is another, the package is missing, no
    scheduler answers within 10 s, no worker has joined after 60 s, or one runs another version.
    """
    place = spec.partition(":")[2]
    host, colon, port = place.partition("://")[2].rpartition(":")
    is_port = port.isascii() and port.isdecimal() and 0 < int(port[:9]) < 65536
    if not (place.startswith(SCHEMES) and host and colon and is_port):
        raise SettingsError(f"--executor {spec}: expected {FORMS}")
    try:
        distributed: Any = import_module("distributed")
    except ImportError as error:
        raise SettingsError(
            f"--executor {spec}: needs the package distributed; pip install 'sparseskin[scale]'"
        ) from error
    if place.startswith("tcp://"):
        print(f"{place}: who controls that scheduler runs code here: use tls://", file=sys.stderr)
    for name in ("distributed", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        # Versions are compared below, in one line.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            client = distributed.Client(place, timeout=CONNECT_S, set_as_default=False)
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
