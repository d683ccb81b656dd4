"""The time of a frame is bounded: the number of iterations is chosen when the graph begins."""

import time

import numpy as np
import pytest
from bags import skin_state

from sparseskin.messages import Measurements, PhiState
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.budget import LEAST_STEPS
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings
from sparseskin.nodes.reconstructor.solvers.base import Solver

N, M = 64, 32


class Clockwork:
    """A clock that a slow solver moves on."""

    def __init__(self):
        self.now_ns = 0

    def perf_counter_ns(self):
        return self.now_ns

    def perf_counter(self):
        return self.now_ns / 1e9


class SlowSolver(Solver):
    """Ten steps of 1 ms each; its estimate is the number of steps done."""

    clockwork: Clockwork
    n_steps = 10

    def setup(self, y, warm=None):
        self.done = 0

    def step(self):
        self.done += 1
        self.clockwork.now_ns += 1_000_000

    def finish(self):
        return np.full((8, 8), self.done, np.float32)

    def reset(self):
        pass


def restored(budget_ms, monkeypatch):
    clockwork = Clockwork()
    SlowSolver.clockwork = clockwork
    monkeypatch.setattr(time, "perf_counter_ns", clockwork.perf_counter_ns)
    monkeypatch.setattr(time, "perf_counter", clockwork.perf_counter)
    monkeypatch.setattr(
        "sparseskin.nodes.reconstructor.patch.make_rotating_solver",
        lambda name, phases, basis, mask, **options: SlowSolver(phases[0], basis, mask),
    )
    settings = ReconstructorSettings(budget_ms=budget_ms)
    node = Reconstructor(settings, Context("reconstructor", ManualClock(0)))
    phi = make_phi("sbhe", N, M, 0)
    list(node.step(skin_state(n_rows=8, n_cols=8, mask=None, rate_hz=0.0)))
    list(
        node.step(PhiState(stamp_ns=0, patch="skin", fingerprint=phi.fingerprint, **phi.describe()))
    )
    y = Measurements(stamp_ns=1, patch="skin", y=np.ones(M, np.float32), phi=phi.fingerprint)
    (found,) = node.step(y)
    return found


@pytest.mark.parametrize(
    ("budget_ms", "steps"), [(None, 10), (5.5, 5), (0.1, LEAST_STEPS), (100.0, 10)]
)
def test_as_many_steps_are_done_as_fit_into_the_budget_and_three_in_any_case(
    budget_ms, steps, monkeypatch
):
    found = restored(budget_ms, monkeypatch)
    assert found.iterations == (steps,)
    assert found.forces[0, 0, 0] == steps
    assert found.solve_ns == (steps * 1_000_000,)


def states(rate_hz, live=True, **settings):
    """What the reconstructor of 32 x 32 taxels states at a rate, in a live graph by default."""
    phi = make_phi("sbhe", 1024, 342, 0)
    context = Context("", ManualClock(0), live=live)
    node = Reconstructor(ReconstructorSettings(**settings), context)
    list(node.step(skin_state(n_rows=32, n_cols=32, mask=None, rate_hz=rate_hz)))
    announced = PhiState(stamp_ns=0, patch="skin", fingerprint=phi.fingerprint, **phi.describe())
    (state,) = node.step(announced)
    return state


def test_the_rate_that_the_skin_states_sets_the_iterations_of_the_default_alone():
    slow, unknown, fast = (states(rate_hz) for rate_hz in (0.01, 0.0, 1e6))
    assert (slow.iterations, unknown.iterations, fast.iterations) == (8, 8, 1)
    assert slow.frame_ms > 0
    assert unknown.frame_ms == 0
    assert states(1e6, live=False).iterations == 8  # offline, no frame waits
    assert states(1e6, iterations=6).iterations == 6
    assert states(1e6, preset="paper").iterations == 30
