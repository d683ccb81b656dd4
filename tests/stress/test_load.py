"""What it costs a graph that others look at it: commands, bridges; and how it keeps time.

At full size half an hour, for the figures of the documents.
"""

import numpy as np
import pytest
from stress.graphs import GraphRun, launch_text
from stress.observers import BRIDGES, LATENCIES, bridge, commands, in_turns, suspending

from sparseskin.messages import Taxels
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter

DEPTH = 16
"""Frames that may wait: on a host that cannot reconstruct them all, the latency is that of those
which are reconstructed, not the length of a growing queue; and the run ends when it should."""
N_TURNS, TURN_S = (30, 1.0)


def graph_text(scene, rate_hz):
    """Launch file of a graph with a node that notes latencies."""
    sensor = {"source": f"sparseskin.studies.looped:{scene}", "rate_hz": rate_hz}
    return (
        launch_text(
            {"sensor": sensor, "compressor": {}, "reconstructor": {"depth": DEPTH}}
        )
        + LATENCIES
    )


def test_commands_beside_a_graph_do_not_make_its_frames_wait(full, note):
    turns = (60, TURN_S) if full else (2, 0.5)
    with GraphRun(graph_text("path_40", 1000.0 if full else 50.0)) as graph:
        own = [graph.process.pid, *graph.nodes().values()]
        with commands(graph) as pids:
            found = in_turns(graph, suspending(pids), own, *turns)
        lost = sum(graph.summary()["nodes"]["reconstructor"]["lost"].values())
    note(beside="echo, hz, bw", lost=lost, **found)
    assert full or lost == 0
    assert found["us_a_frame"] > 0


@pytest.mark.parametrize("kind", BRIDGES)
def test_a_bridge_beside_a_graph_does_not_make_its_frames_wait(kind, full, note):
    pytest.importorskip({"foxglove": "foxglove", "ros2": "cyclonedds"}.get(kind, "zmq"))
    turns = (N_TURNS, TURN_S) if full else (2, 0.5)
    text = graph_text("drag_wrench_64", 200.0 if full else 50.0)
    with GraphRun(text) as graph, bridge(graph, kind) as (pids, node):
        found = in_turns(graph, suspending(pids), [node], *turns)
        lost = sum(graph.summary()["nodes"]["reconstructor"]["lost"].values())
    note(beside=kind, lost=lost, **found)
    assert full or lost == 0
    assert found["us_a_frame"] > 0


@pytest.mark.parametrize(
    ("rate_hz", "speed"), [(100, 1.0), (100, 10.0), (1000, 0.1), (1000, 1.0)]
)
def test_a_replay_keeps_its_rate(rate_hz, speed, full, note, tmp_path):
    n_frames = round(rate_hz * speed * (60.0 if full else 1.0)) + 1
    forces = np.zeros((8, 8), np.float32)
    with BagWriter(tmp_path / "in.mcap", {"scene": "timing"}) as bag:
        for k in range(n_frames):
            stamp_ns = k * 1_000_000_000 // rate_hz
            frame = Taxels(
                stamp_ns=stamp_ns, patch="skin", run_id="0" * 16, seq=k, forces=forces
            )
            bag.record(frame, stamp_ns)
    nodes = {
        "player": {"file": "in.mcap", "rate": speed},
        "recorder": {"out": "out.mcap"},
    }
    with GraphRun(launch_text(nodes), folder=tmp_path) as graph:
        assert graph.wait(None) == 0
    with BagReader(tmp_path / "out.mcap") as bag:
        sent_ns = np.array([message.stamp_ns for message in bag.messages()], np.int64)
    assert len(sent_ns) == n_frames
    late_ms = (
        sent_ns - sent_ns[0] - np.arange(n_frames) * 1e9 / (rate_hz * speed)
    ) / 1e6
    # Frames are never early, so the earliest of many shows where the schedule lies.
    late_ms -= late_ms.min()
    tenth = max(1, n_frames // 10)
    note(
        **{"recorded, Hz": rate_hz, "rate": speed, "frames": n_frames},
        **{f"p{q} ms": round(float(np.percentile(late_ms, q)), 3) for q in (50, 99)},
        achieved_hz=round((n_frames - 1) / ((sent_ns[-1] - sent_ns[0]) / 1e9), 2),
        drift_ms=round(
            float(np.median(late_ms[-tenth:]) - np.median(late_ms[:tenth])), 3
        ),
    )
