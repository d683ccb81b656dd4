"""The time of a frame is bounded: the node stops iterating when its budget is over."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from sparseskin.messages import Measurements, PhiState, Reconstruction, SkinState
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings
from sparseskin.nodes.reconstructor.solvers.base import Solver

N, M = 64, 32


class Clockwork:
    """A clock that a slow solver moves on."""

    def __init__(self) -> None:
        self.now_ns = 0

    def perf_counter_ns(self) -> int:
        return self.now_ns


class SlowSolver(Solver):
    """Ten steps of 1 ms each; its estimate is the number of steps done."""

    clockwork: Clockwork
    n_steps = 10

    def setup(self, y: Any, warm: Any = None) -> None:
        self.done = 0

    def step(self) -> None:
        self.done += 1
        self.clockwork.now_ns += 1_000_000

    def finish(self) -> Any:
        return np.full((8, 8), self.done, np.float32)

    def reset(self) -> None:
        pass


def skin_state(side: int, rate_hz: float) -> SkinState:
    return SkinState(
        stamp_ns=0, patch="skin", n_rows=side, n_cols=side, f_max=2.5, unit="N", pitch_m=None,
        mask=None, source="", seed=0, rate_hz=rate_hz, has_truth=False, sigma_mid=0.0,
        sigma_end=0.0,
    )  # fmt: skip


def restored(budget_ms: float | None, monkeypatch: pytest.MonkeyPatch) -> Reconstruction:
    clockwork = Clockwork()
    SlowSolver.clockwork = clockwork
    monkeypatch.setattr(time, "perf_counter_ns", clockwork.perf_counter_ns)
    monkeypatch.setattr(
        "sparseskin.nodes.reconstructor.patch.make_rotating_solver",
        lambda name, phases, basis, mask, **options: SlowSolver(phases[0], basis, mask),
    )
    settings = ReconstructorSettings(budget_ms=budget_ms)
    node = Reconstructor(settings, Context("reconstructor", ManualClock(0)))
    phi = make_phi("sbhe", N, M, 0)
    list(node.step(skin_state(8, 0.0)))
    list(
        node.step(PhiState(stamp_ns=0, patch="skin", fingerprint=phi.fingerprint, **phi.describe()))
    )
    y = Measurements(stamp_ns=1, patch="skin", y=np.ones(M, np.float32), phi=phi.fingerprint)
    (found,) = node.step(y)
    assert isinstance(found, Reconstruction)
    return found


@pytest.mark.parametrize(("budget_ms", "steps"), [(None, 10), (3.5, 3), (0.1, 1), (100.0, 10)])
def test_no_step_is_begun_that_would_end_beyond_the_budget(
    budget_ms: float | None, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = restored(budget_ms, monkeypatch)
    assert found.iterations == (steps,)
    assert found.forces[0, 0, 0] == steps
    assert found.solve_ns == (steps * 1_000_000,)


def test_the_rate_that_the_skin_states_bounds_the_smooth_model_of_plain_numpy() -> None:
    phi = make_phi("sbhe", 1024, 342, 0)
    y = phi.forward(np.linspace(0, 1, 1024, dtype=np.float32))
    node = Reconstructor(ReconstructorSettings(fast="off"), Context("", ManualClock(0)))
    list(
        node.step(PhiState(stamp_ns=0, patch="skin", fingerprint=phi.fingerprint, **phi.describe()))
    )
    steps = []
    for k, rate_hz in enumerate((0.0, 1e6, 0.0)):
        list(node.step(skin_state(32, rate_hz)))
        sign = (-1) ** k  # each frame is a jump: it has all iterations
        measured = Measurements(stamp_ns=k, patch="skin", y=sign * y, phi=phi.fingerprint)
        (found,) = node.step(measured)
        assert isinstance(found, Reconstruction)
        steps.append(found.iterations[0])
    assert steps == [35, 30, 32]
