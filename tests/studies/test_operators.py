"""Study `operators`: the timed calls are the same operator, and every figure is there."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.studies.operators import study as operators
from sparseskin.studies.operators.c import CFloor, c_compiler
from sparseskin.studies.operators.peers import (
    ADJOINT,
    ANALYSIS,
    FORWARD,
    PEERS,
    SYNTHESIS,
    missing_peers,
    peer_calls,
)
from sparseskin.studies.operators.study import OPERATORS, median_us, time_operators, time_solvers
from sparseskin.studies.points import StudyError


@pytest.mark.parametrize("peer", PEERS)
@pytest.mark.parametrize("side", [8, 12])
def test_the_timed_calls_of_a_peer_are_the_same_operator(peer: str, side: int) -> None:
    if peer in missing_peers():
        pytest.skip(f"{peer} is not installed")
    n = side * side
    phi, basis = SbhePhi(n, n // 3, 0), HaarBasis(side, side)
    frames = np.random.default_rng(0).random((2, side, side), dtype=np.float32)
    calls = peer_calls(peer, phi, basis, frames)
    assert set(calls) <= set(OPERATORS)
    for by_count in calls.values():
        assert set(by_count) == {1, 2}
        for call in by_count.values():
            call()
    if peer == "PyLops":
        y = phi.forward(frames[0].reshape(-1))
        np.testing.assert_allclose(calls[FORWARD][1](), y, atol=1e-5)
        np.testing.assert_allclose(calls[ADJOINT][1](), phi.adjoint(y), atol=1e-5)
    if peer == "scipy.sparse":
        x = np.random.default_rng(0).standard_normal((n, 2)).astype(np.float32)
        np.testing.assert_allclose(calls[FORWARD][2](), phi.forward(x.T).T, atol=1e-5)
        theta = basis.analysis(np.ascontiguousarray(x[:, 0]).reshape(side, side))
        np.testing.assert_allclose(calls[ANALYSIS][1](), theta.reshape(-1), atol=1e-5)
    if peer != "scipy.sparse" and side == 8:
        theta = np.asarray(basis.analysis(frames[0]), dtype=float)
        found = calls[SYNTHESIS][1]()
        np.testing.assert_allclose(np.reshape(found, (side, side)), frames[0], atol=1e-5)
        assert np.linalg.norm(theta) == pytest.approx(np.linalg.norm(frames[0]), rel=1e-5)


def test_a_size_has_every_operator_with_its_floors() -> None:
    point = {"side": 8, "batch": 2, "seed": 0, "windows": 1, "peers": []}
    rows = time_operators(point)["rows"]
    assert {row["operator"] for row in rows} == set(OPERATORS)
    assert all(row["alone_us"] > 0 and row["flop_us"] > 0 and row["memory_us"] > 0 for row in rows)


def test_solvers_are_timed_a_frame_and_an_iteration() -> None:
    rows = time_solvers({"side": 24, "n_frames": 8, "seed": 0, "windows": 3})["rows"]
    ways = {row["way"] for row in rows}
    assert ("numba" in ways) == (importlib.util.find_spec("numba") is not None)
    assert ("C" in ways) == (c_compiler() is not None)
    assert all(row["iteration_us"] > 0 for row in rows)
    assert all(row["iterations"] >= 3 for row in rows if row["way"] != "C")


def test_c_iterates_without_growing() -> None:
    if c_compiler() is None:
        pytest.skip("no C compiler is installed")
    floor = CFloor(64, 3)
    for _ in range(50):
        floor.fista()
        floor.skin()
    assert all(np.isfinite(vector).all() for vector in floor.vectors)


def test_the_median_is_of_a_call() -> None:
    calls = []
    assert median_us(lambda: calls.append(1), windows=3) > 0
    assert len(calls) >= 5


def test_what_is_not_installed_is_logged_before_anything_is_timed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def compute(*_: object) -> None:
        raise StudyError("nothing is to be timed here")

    monkeypatch.setattr(operators, "missing_peers", lambda: list(PEERS))
    monkeypatch.setattr(operators, "c_compiler", lambda: None)
    monkeypatch.setattr(operators, "compute", compute)
    with pytest.raises(StudyError):
        operators.run(tmp_path, True, 0, "serial")
    logged = capsys.readouterr().err
    for peer in PEERS:
        assert f"left out: {peer} is not installed (pip install 'sparseskin[peers]')" in logged
    assert "left out: no C compiler is installed" in logged


@pytest.mark.slow  # a whole small study, with its charts
def test_what_is_not_installed_is_left_out_with_a_notice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(operators, "QUICK_SIDES", (8, 24))
    monkeypatch.setattr(operators, "TIMED_ON", "serial")
    monkeypatch.setattr(operators, "missing_peers", lambda: list(PEERS))
    monkeypatch.setattr(operators, "c_compiler", lambda: None)
    monkeypatch.setattr(operators, "has_numba", lambda: False)
    monkeypatch.setattr(operators, "QUICK_WINDOWS", 3)
    pytest.importorskip("matplotlib")
    operators.run(tmp_path, True, 0, "serial")
    errors = capsys.readouterr().err
    assert "left out: numba is not installed (pip install 'sparseskin[fast]')" in errors
    assert "left out: PyLops is not installed (pip install 'sparseskin[peers]')" in errors
    assert "left out: no C compiler is installed" in errors
    page = (tmp_path / "operators.md").read_text()
    assert "**Left out:** PyLops" in page
    assert "PyLops |" not in page
    assert (tmp_path / "operators.png").exists()
    assert (tmp_path / "iterations.csv").exists()
