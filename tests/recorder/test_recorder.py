"""When a recorder begins its file: once the states are known, or it has waited long enough."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from bags import PHI, frame, skin_state

from sparseskin.messages import Message, PhiState, SolverState
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.node import Context
from sparseskin.nodes.recorder.bag_reader import BagReader
from sparseskin.nodes.recorder.node import MOST_WAITING, PATIENCE_NS, Recorder

STATES: list[Message] = [
    skin_state(),
    PhiState(stamp_ns=0, patch="skin", kind="sbhe", n=34, m=12, block=32, seed=0, fingerprint=PHI),
    SolverState(
        stamp_ns=0, patch="skin", solver="skin", basis="", preset="skin", iterations=3, lambda_n=0.0
    ),
]


@pytest.mark.parametrize(
    ("n_before", "apart_ns", "knows_phi"),
    [
        (200, PATIENCE_NS // 400, True),  # a fast graph, whose states come after half the time
        (200, PATIENCE_NS // 100, False),
        (MOST_WAITING + 1, 0, False),
        (60, PATIENCE_NS, True),  # a slow one: few messages have come
    ],
)
def test_states_that_come_a_little_late_are_in_the_metadata(
    tmp_path: Path, n_before: int, apart_ns: int, knows_phi: bool
) -> None:
    clock = ManualClock()
    settings = Recorder.Settings(out=str(tmp_path / "a.mcap"))
    recorder = Recorder(settings, Context("recorder", clock))
    for k in range(n_before):
        clock.advance(apart_ns)
        recorder.step(frame(k)[0].published("0" * 16, k))
    for state in STATES:
        recorder.step(state.published("0" * 16, 0))
    recorder.close({})
    with BagReader(tmp_path / "a.mcap") as bag:
        assert bool(json.loads(bag.metadata["phi"])) is knows_phi
        assert sum(info.n_messages for info in bag.topics.values()) == n_before + len(STATES)
