"""Executors on Dask clusters, by name."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.tasks.executors import make_executor
from sparseskin.plugins.cluster import dask as dask_cluster

pytest.importorskip("distributed")


@pytest.mark.parametrize("spec", ["dask:tcp://host", "dask:tcp://host:0", "dask:inproc://1"])
def test_a_cluster_that_cannot_be_meant_is_refused(spec: str) -> None:
    with pytest.raises(SettingsError, match="expected dask:tcp://HOST:PORT"):
        make_executor(spec)


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SettingsError, match=r"the package distributed; .*sparseskin\[scale\]"):
        make_executor("dask:tcp://host:8786")


def test_what_a_scheduler_without_keys_can_do_is_said_before_it_is_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(dask_cluster, "CONNECT_S", 0.1)
    for scheme, said in (("tcp", True), ("tls", False)):
        with pytest.raises(SettingsError):
            make_executor(f"dask:{scheme}://127.0.0.1:1")
        assert ("runs code here" in capsys.readouterr().err) == said


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
