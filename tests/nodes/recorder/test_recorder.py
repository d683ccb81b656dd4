"""The recorder node: the time until messages reach the disk."""

import functools

from bags import PHI, FakeClock, frame, on_disk, skin_state

from sparseskin.messages import PhiState, SolverState
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.node import Context
from sparseskin.nodes.recorder import node as recorder_module
from sparseskin.nodes.recorder.bag.writer import BagWriter
from sparseskin.nodes.recorder.node import Recorder

STATES = [
    skin_state(),
    PhiState(stamp_ns=0, patch="skin", kind="sbhe", n=34, m=12, block=32, seed=0, fingerprint=PHI),
    SolverState(
        stamp_ns=0, patch="skin", solver="skin", basis="", preset="skin", iterations=3, lambda_n=0.0
    ),
]


def test_messages_reach_the_disk_after_a_tenth_of_a_second(tmp_path, monkeypatch):
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
