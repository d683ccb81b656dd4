"""Executors on Dask clusters, by name."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

import pytest

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.tasks.executors import make_executor
from sparseskin.plugins.cluster import dask as dask_cluster

pytest.importorskip("distributed")


def _threads(_: int) -> str | None:
    return os.environ.get("OMP_NUM_THREADS")


def _fails(_: int) -> None:
    raise ValueError("two\nlines")


@pytest.mark.slow
def test_a_cluster_of_this_host_computes_on_one_core_each_and_ends_with_the_executor() -> None:
    with make_executor("dask:local:2") as executor:
        cluster = executor._cluster  # type: ignore[attr-defined]
        assert len(cluster.workers) == 2
        assert [executor.submit(_threads, k).result() for k in range(2)] == ["1", "1"]
        # Encrypted, with keys of this run: no other user can have code run by it.
        assert cluster.scheduler_address.startswith("tls://127.0.0.1:")
        with pytest.raises(ValueError, match="two"):
            executor.submit(_fails, 0).result()
    assert cluster.status.name == "closed"


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        ("dask", "expected dask:local"),
        ("dask:", "expected dask:local"),
        ("dask:locl", "expected dask:local"),
        ("dask:local:0", "expected 1..1024 workers"),
        ("dask:local:" + "9" * 5000, "expected 1..1024 workers"),
        ("dask:local:²", "expected 1..1024 workers"),
        ("dask:tcp://", "expected dask:local"),
        ("dask:tcp://host", "expected dask:local"),
        ("dask:tcp://host:0", "expected dask:local"),
        ("dask:inproc://1", "expected dask:local"),
    ],
)
def test_a_cluster_that_cannot_be_meant_is_refused(spec: str, text: str) -> None:
    with pytest.raises(SettingsError, match=text):
        make_executor(spec)


@pytest.mark.parametrize("module", ["distributed", "cryptography"])
def test_a_missing_package_is_named_with_its_extra(
    monkeypatch: pytest.MonkeyPatch, module: str
) -> None:
    if module == "distributed":
        monkeypatch.setitem(sys.modules, module, None)
    else:
        import distributed

        def temporary() -> None:
            raise ImportError

        monkeypatch.setattr(distributed.Security, "temporary", temporary)
    with pytest.raises(SettingsError, match=rf"needs the package {module}; .*sparseskin\[scale\]"):
        make_executor("dask:local:1")


class FakeClient:
    """Answers of a scheduler with one worker."""

    def __init__(self, answer: object, n_workers: int = 1) -> None:
        self._answer, self._n = answer, n_workers

    def wait_for_workers(self, n: int, timeout: float) -> None:
        if self._n < n:
            raise TimeoutError

    def run(self, function: Callable[[], object], on_error: str) -> dict[str, object]:
        return {"tcp://10.0.0.2:1": self._answer}


@pytest.mark.parametrize(
    ("answer", "n_workers", "text"),
    [
        ({**dask_cluster.versions_here(), "Python": "3.9"}, 1, "runs Python 3.9, this process 3."),
        ({**dask_cluster.versions_here(), "sparseskin": "0.0"}, 1, "runs sparseskin 0.0, this"),
        (ModuleNotFoundError("No module named 'sparseskin'"), 1, "No module named 'sparseskin'"),
        ("?", 1, "no answer"),
        (None, 0, "no worker has joined the scheduler after 60 s"),
    ],
)
def test_workers_that_run_other_code_or_are_not_there_are_named(
    answer: object, n_workers: int, text: str
) -> None:
    with pytest.raises(SettingsError, match=text) as raised:
        dask_cluster._check_versions("dask:tcp://h:1", FakeClient(answer, n_workers))
    assert "\n" not in str(raised.value)
