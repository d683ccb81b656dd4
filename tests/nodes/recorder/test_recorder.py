"""The recorder node: the beginning of its file, and the time until messages reach the disk."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import pytest
from bags import PHI, FakeClock, frame, on_disk, skin_state

from sparseskin.messages import Message, PhiState, SolverState
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.node import Context
from sparseskin.nodes.recorder import node as recorder_module
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter
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


def test_messages_reach_the_disk_after_a_tenth_of_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, path = FakeClock(), tmp_path / "a.mcap"
    monkeypatch.setattr(recorder_module, "BagWriter", functools.partial(BagWriter, monotonic=clock))
    settings = Recorder.Settings(out=str(path))
    recorder = Recorder(settings, Context("recorder", ManualClock()))
    for state in STATES:
        recorder.step(state.published("0" * 16, 0))
    recorder.step(frame(0)[0].published("0" * 16, 0))
    clock.now_s = 0.099
    recorder.idle()
    assert on_disk(path) == []
    clock.now_s = 0.1
    recorder.idle()
    assert len(on_disk(path)) == len(STATES) + 1
    recorder.close({})
