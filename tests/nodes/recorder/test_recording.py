"""Recording and playing with real processes."""

import functools
import json
import os
import re
import signal

import pytest
from bags import PHI, FakeClock, frame, on_disk, skin_state
from conftest import note_of_graph, wait_until

from sparseskin.messages import PhiState, SolverState, decode
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.node import Context
from sparseskin.nodes.recorder import node as recorder_module
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter
from sparseskin.nodes.recorder.node import Recorder

SLOWLY = ("--set", "sensor.rate_hz=20", "--set", "reconstructor.iterations=3")
N_FRAMES = 400
"""Of path_40, which is touched from frame 320 on."""


def contents(path):
    """Stamps and payloads of a whole recording, by topic."""
    with BagReader(path) as bag:
        assert bag.recovered == ""
        assert not any(bag.counts["lost"].values())
        return {
            t: [(m.stamp_ns, m.payload) for m in bag.messages([t])] for t in bag.topics
        }


def topics(path):
    """Topics that have a message in a recording, which may still be written, or just begun."""
    if not path.exists():
        return set()
    try:
        with BagReader(path) as bag:
            return {message.topic for message in bag.messages()}
    except BagError:
        # Of a file that was opened a moment ago the disk has no header yet.
        return set()


@pytest.mark.slow
def test_played_in_lockstep_and_recorded_again_it_is_the_same_but_for_the_run(
    start, tmp_path
):
    launched = start(
        *("launch", "path_40", "--frames", str(N_FRAMES), "--record", "first.mcap"),
        *("--set", "sensor.rate_hz=0", "--set", "reconstructor.iterations=5"),
    )
    stdout, _ = launched.ended()
    assert re.fullmatch(
        r"first.mcap: \d+ messages recorded, 0 dropped", stdout.splitlines()[-1]
    )
    player = start("play", "first.mcap", "--lockstep", "--rate", "0")
    player.wait_for("[launch] ready")
    note_of_graph(tmp_path / "graphs")
    stdout, _ = start("record", "--out", "second.mcap").ended()
    assert "0 dropped" in stdout
    assert player.finish()[:2] == (0, f"first.mcap: {N_FRAMES} frames played\n")
    first, second = (
        {
            topic: [
                (ns, decode(topic.encode(), p).published("", k))
                for k, (ns, p) in enumerate(of)
            ]
            for topic, of in contents(tmp_path / name).items()
        }
        for name in ("first.mcap", "second.mcap")
    )
    assert first == second
    assert len(first["/skin/reconstruction"]) == N_FRAMES


@pytest.mark.slow
@pytest.mark.parametrize("killed", [False, True])
def test_a_recorder_joins_a_running_graph_by_topic_and_ends_with_it(
    start, tmp_path, killed
):
    graph = start("launch", "path_40", "--summary", "out.json", *SLOWLY)
    graph.wait_for("[launch] ready")
    recorder = start("record", "/skin/skin", "/skin/rec*", "--out", "some.mcap")
    recorder.wait_for("[launch] ready")
    part = tmp_path / "some.mcap.part"
    wait_until(
        lambda: "/skin/reconstruction" in topics(part), "a reconstruction in the file"
    )
    graph.process.send_signal(signal.SIGKILL if killed else signal.SIGINT)
    stdout, stderr = recorder.ended()
    assert stdout.startswith("some.mcap: ")
    found = contents(tmp_path / "some.mcap")
    assert set(found) == {"/skin/skin", "/skin/reconstruction"}
    if killed:
        assert (
            "was gone before its streams had ended: its last messages may be miss"
            in stderr
        )
        return
    assert graph.finish()[0] == 130
    # It saw the graph to its very end.
    last = decode(b"/skin/reconstruction", found["/skin/reconstruction"][-1][1])
    frames = json.loads((tmp_path / "out.json").read_text())["patches"]["skin"][
        "frames"
    ]
    assert last.seq == frames["reconstructed"] - 1


def test_the_end_names_the_file_that_a_killed_recorder_has_left(
    start, sensor, tmp_path
):
    graph = start("launch", sensor, "--record", "run.mcap")
    wait_until(
        lambda: "/skin/taxels" in topics(tmp_path / "run.mcap.part"),
        "frames in the file",
    )
    os.kill(graph.pid_of("recorder"), signal.SIGKILL)
    graph.wait_for("[launch] recorder ended too early")
    graph.process.send_signal(signal.SIGINT)
    left = "what was recorded before it ended is in run.mcap.part (sparseskin recording recover"
    assert f"recorder: {left}" in graph.finish()[1]


@pytest.mark.slow
def test_an_interrupted_recorder_completes_its_file(start, sensor, tmp_path):
    graph = start("launch", sensor)
    graph.wait_for("[launch] ready")
    _, stderr = start("record", "/skin/taxel").ended(2)
    assert "/skin/taxel: " in stderr
    assert "did you mean '/skin/taxels'?" in stderr
    recorder = start("record", "--out", "cut.mcap")
    recorder.wait_for("[launch] ready")
    part = tmp_path / "cut.mcap.part"
    wait_until(lambda: part.exists() and part.stat().st_size > 20_000, "some messages")
    recorder.process.send_signal(signal.SIGINT)
    stdout, stderr = recorder.ended()
    assert "messages recorded, 0 dropped" in stdout
    assert "not drained" not in stderr
    assert len(contents(tmp_path / "cut.mcap")["/skin/taxels"]) > 1
    graph.process.terminate()
    graph.finish()


STATES = [
    skin_state(),
    PhiState(
        stamp_ns=0,
        patch="skin",
        kind="sbhe",
        n=34,
        m=12,
        block=32,
        seed=0,
        fingerprint=PHI,
    ),
    SolverState(
        stamp_ns=0,
        patch="skin",
        solver="skin",
        basis="",
        preset="skin",
        iterations=3,
        lambda_n=0.0,
    ),
]


def test_messages_reach_the_disk_after_a_tenth_of_a_second(tmp_path, monkeypatch):
    clock = FakeClock()
    path = tmp_path / "a.mcap"
    monkeypatch.setattr(
        recorder_module, "BagWriter", functools.partial(BagWriter, monotonic=clock)
    )
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
