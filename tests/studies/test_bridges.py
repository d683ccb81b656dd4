"""Frames that bridges send at 1 kHz reach a real client, or are counted."""

from __future__ import annotations

import pytest

from sparseskin.studies.bridges.study import WARM_UP, counted, steps

#: Fewer than the client of each bridge may be behind.
N_FRAMES = 300


@pytest.mark.parametrize(("bridge", "module"), [("foxglove", "foxglove"), ("ros2", "cyclonedds")])
def test_every_frame_is_read_by_the_client_or_counted_as_dropped(bridge: str, module: str) -> None:
    pytest.importorskip(module)
    found = counted({"bridge": bridge, "n_counted": N_FRAMES, "seed": 0})
    assert (found["received"], found["dropped"]) == (N_FRAMES, 0)


def test_a_reader_of_the_newest_frame_alone_reads_the_last_one() -> None:
    found = counted({"bridge": "lerobot", "n_counted": N_FRAMES, "seed": 0})
    assert 1 <= found["received"] <= N_FRAMES
    assert found["dropped"] == 0


def test_the_client_of_a_bridge_that_sends_30_frames_a_second_reads_one() -> None:
    assert steps({"bridge": "lerobot, 30 Hz", "n_steps": WARM_UP + 50, "seed": 0})["step_us"] > 0
