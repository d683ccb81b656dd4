"""The time of a frame is bounded: iterations are chosen, and all imported, as a graph begins."""

import subprocess
import sys
import time

import numpy as np
import pytest
from bags import skin_state
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages import Measurements, PhiState
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.budget import LEAST_STEPS
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings
from sparseskin.nodes.reconstructor.skin.vectors import (
    CONVERGED,
    FORMULA_SHARE,
    N_FORMULA,
    StepPlan,
    steps_for,
)
from sparseskin.nodes.reconstructor.solvers.base import Solver


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


def set_up(side, rate_hz, live, **settings):
    """A reconstructor that knows its skin and matrix, the matrix, and what it states."""
    phi = make_phi("sbhe", side * side, side * side // 3, 0)
    context = Context("reconstructor", ManualClock(0), live=live)
    node = Reconstructor(ReconstructorSettings(**settings), context)
    list(node.step(skin_state(n_rows=side, n_cols=side, mask=None, rate_hz=rate_hz)))
    announced = PhiState(
        stamp_ns=0, patch="skin", fingerprint=phi.fingerprint, **phi.describe()
    )
    return node, phi, next(iter(node.step(announced)), None)


def restored(budget_ms, monkeypatch):
    clockwork = Clockwork()
    SlowSolver.clockwork = clockwork
    monkeypatch.setattr(time, "perf_counter_ns", clockwork.perf_counter_ns)
    monkeypatch.setattr(time, "perf_counter", clockwork.perf_counter)
    monkeypatch.setattr(
        "sparseskin.nodes.reconstructor.patch.make_rotating_solver",
        lambda name, phases, basis, mask, **options: SlowSolver(phases[0], basis, mask),
    )
    node, phi, _ = set_up(8, 0.0, False, budget_ms=budget_ms)
    values = np.arange(phi.m, dtype=np.float32)
    y = Measurements(stamp_ns=1, patch="skin", y=values, phi=phi.fingerprint)
    (found,) = node.step(y)
    return found


@pytest.mark.parametrize(
    ("budget_ms", "n"), [(None, 10), (5.5, 5), (0.1, LEAST_STEPS), (100, 10)]
)
def test_as_many_steps_are_done_as_fit_but_at_least_three(budget_ms, n, monkeypatch):
    found = restored(budget_ms, monkeypatch)
    assert found.iterations == (n,)
    assert found.forces[0, 0, 0] == n
    assert found.solve_ns == (n * 1_000_000,)


def states(rate_hz, live=True, **settings):
    """What the reconstructor of 32 x 32 taxels states at a rate, in a live graph by default."""
    return set_up(32, rate_hz, live, **settings)[2]


def test_the_rate_that_the_skin_states_sets_the_iterations_of_the_default_alone():
    slow, unknown, fast = (states(rate_hz) for rate_hz in (0.01, 0.0, 1e6))
    assert slow.iterations == 24
    assert unknown.iterations == 24
    assert fast.iterations == 1
    assert slow.frame_ms > unknown.frame_ms == 0
    assert states(1e6, live=False).iterations == 24  # offline, no frame waits
    assert states(1e6, iterations=6).iterations == 6
    assert states(1e6, preset="paper").iterations == 30


def test_steps_that_are_chosen_by_tiles_are_stated_and_bounded_by_their_time():
    node, phi, state = set_up(32, 1e6, True)
    # nothing fits into a microsecond
    assert (state.max_iterations, state.frame_tiles) == (
        24,
        1,
    )
    node, phi, state = set_up(
        32, 1000.0, False, options={"frame_tiles": 90, "step_tiles": 10}
    )
    assert state.iterations == 1
    assert state.max_iterations == 24
    assert state.frame_tiles == 90
    assert state.step_tiles == 10

    def n_steps(forces):
        y = phi.forward(forces.astype(np.float32))
        (found,) = node.step(
            Measurements(stamp_ns=1, patch="skin", y=y, phi=phi.fingerprint)
        )
        return found.iterations[0]

    single = np.zeros(phi.n)
    single[200] = 1
    all_pressed = np.random.default_rng(0).uniform(1, 2, phi.n)
    assert 1 <= n_steps(all_pressed) < n_steps(single) <= 9


TIMES = st.integers(1, 2000)


@given(TIMES, st.integers(1, 60), st.integers(1, 24), st.integers(0, 500))
def test_counted_steps_fit_into_their_time_and_fall_with_the_tiles(
    frame, step, most, n_tiles
):
    plan = StepPlan(N_FORMULA, 1, 0, frame, step, most, 0.0, 0.0)
    chosen, fewer = (steps_for(plan, n) for n in (n_tiles, n_tiles + 1))
    assert 1 <= fewer.n <= chosen.n <= most
    by_formula = chosen.n_formula * (step + n_tiles // FORMULA_SHARE)
    assert chosen.n == 1 or by_formula + chosen.n * (step + n_tiles) <= frame
    assert chosen.n_formula == (0 if chosen.n >= CONVERGED else N_FORMULA)


CODE = """
import sys
import numpy as np
from sparseskin.messages import Measurements, PhiState, SkinState
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.node import Sensor

class Observed(Reconstructor):
    def step(self, message):
        before = set(sys.modules)
        made = list(super().step(message))
        print(type(message).__name__, len(made), sorted(set(sys.modules) - before))
        return made

settings = Reconstructor.Settings(preset=sys.argv[1], fast="off")
nodes = {
    "sensor": (Sensor, Sensor.Settings(source="scene:path_40")),
    "compressor": (Compressor, Compressor.Settings()),
    "reconstructor": (Observed, settings),
}
bus = Bus(nodes, ManualClock(0))
for _ in bus.frames(1):
    pass
assert "numba" not in sys.modules
"""


@pytest.mark.parametrize("preset", ["skin", "paper"])
def test_the_first_frame_imports_nothing_and_off_no_numba(preset):
    done = subprocess.run(
        [sys.executable, "-c", CODE, preset],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == "Measurements 1 []"
    assert "PhiState 1 []" in done.stdout
