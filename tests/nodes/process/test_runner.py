"""The loop of a node's process."""

import pytest

from sparseskin.nodes.process import runner


@pytest.mark.parametrize(
    ("frame_ns", "n"), [(1_000, runner.BATCH), (runner.BATCH_NS // 4, 4), (2 * runner.BATCH_NS, 1)]
)
def test_slow_frames_keep_a_command_waiting_for_one_frame_at_most(frame_ns, n, monkeypatch):
    now_ns = 0
    monkeypatch.setattr(runner.time, "monotonic_ns", lambda: now_ns)
    n_frames = 0
    for _ in runner._batch():
        n_frames += 1
        now_ns += frame_ns
    assert n_frames == n
