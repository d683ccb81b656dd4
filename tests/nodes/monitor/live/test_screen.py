"""The monitor as text: every figure, in lines that fit a terminal of 80 columns."""

import numpy as np
import pytest
from bags import PHI
from feeds import FakeTime, Graph, graph_state, node_state

from sparseskin.messages import Measurements, PhiState, Reconstruction, Taxels, Truth
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.monitor.live.notices import Notices, host_lines
from sparseskin.nodes.monitor.live.screen import WIDTH, screen
from sparseskin.nodes.monitor.node import Monitor
from sparseskin.nodes.monitor.table import summary_table
from sparseskin.nodes.node import Context

SHAPE = (4, 6)
STATUS = "skin: 50 frames, 50 Hz, lost 0 | PSNR of contact frames 40.0 dB (taxels 20.0) | " * 2
ERROR_N = (0.25, 0.025)
"""Of the taxels and of what is restored: 20 dB and 40 dB for a range of 2.5 N."""


@pytest.fixture
def clock(monkeypatch):
    return FakeTime(monkeypatch)


def filled(clock, n_frames=50):
    """A graph at 100 Hz in which one taxel bears 2 N, uniformly wrong by ERROR_N."""
    graph = Graph()
    graph.skin(n_rows=SHAPE[0], n_cols=SHAPE[1], mask=None, source="a scene")
    head = {"patch": "skin", "run_id": "0" * 16}
    fields = {"kind": "sbhe", "n": 24, "m": 8, "block": 8, "seed": 0, "fingerprint": PHI}
    graph.take(PhiState(**head, stamp_ns=0, **fields))
    truth = np.zeros(SHAPE, np.float32)
    truth[1, 4] = 2.0
    noisy, restored = (truth + np.float32(error) for error in ERROR_N)
    rest = {"phi": PHI, "iterations": 30, "residual": 0.0, "solve_ns": 2_000_000, "done_ns": 0}
    for k in range(n_frames):
        clock.advance(0.01)
        of_frame = {**head, "seq": k, "stamp_ns": 1000 * k}
        rest["done_ns"] = 1000 * k + 5_000_000
        graph.take(Taxels(**of_frame, forces=noisy))
        graph.take(Truth(**of_frame, forces=truth))
        graph.take(Measurements(**of_frame, y=np.ones(8, np.float32), phi=PHI))
        graph.take(Reconstruction(**of_frame, **rest, forces=restored))
    graph.summarise()
    return graph


def lines_of(graph):
    lines = screen(graph.feed, Notices(graph.feed), STATUS).split("\n")
    assert max(map(len, lines)) <= WIDTH == 79
    return lines


def test_status_and_figures_are_those_of_the_line_and_of_the_summary(clock):
    graph = filled(clock)
    lines = lines_of(graph)
    table = summary_table({"skin": graph.feed.patches["skin"].summary}).split("\n")
    assert lines[-len(table) :] == table
    assert " ".join(lines[: -len(table)]).endswith(STATUS.strip())


def test_a_frame_that_is_not_to_be_trusted_is_marked_for_as_long_as_a_person_needs(clock):
    graph = filled(clock)
    graph.skin()
    graph.n["skin"] = 50

    def marked(trusted):
        graph.frame(error=0.1, trusted=trusted, reason="" if trusted else "error")
        return "!! skin: not trusted (error)" in lines_of(graph)

    assert not marked(trusted=True)
    assert marked(trusted=False)
    clock.advance(0.49)
    assert marked(trusted=True)
    clock.advance(0.02)
    assert not marked(trusted=True)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"heard": False, "silent": ["sensor", "compressor"]},
            ("silent", "host edge: receives nothing from sensor, compressor"),
        ),
        (
            {"heard": True, "clock_offset_ms": -0.124, "clock_uncertainty_ms": 0.3},
            ("heard", "host edge: connected, clock -0.12 ± 0.30 ms"),
        ),
    ],
)
def test_each_other_host_is_a_line(clock, changes, told):
    unknown = {"heard": None, "silent": [], "clock_offset_ms": None, "clock_uncertainty_ms": None}
    graph = filled(clock)
    assert not any(line.startswith("host") for line in lines_of(graph))
    graph.feed.update(graph=graph_state(hosts={"edge": unknown | changes}))
    assert graph.feed.graph is not None
    assert host_lines(graph.feed.graph) == [told]
    assert told[1] in lines_of(graph)


def test_long_names_and_many_nodes_still_fit(clock):
    graph = filled(clock)
    nodes = [node_state(f"node_{k}_" + "x" * 24, condition="restarting") for k in range(12)]
    state = graph_state(*nodes, name="n" * 100, recording="r" * 100 + ".mcap")
    graph.feed.update(graph=state)
    graph.skin(source="s" * 200)
    text = "\n".join(lines_of(graph))
    for k in range(12):
        assert f"!! node_{k}_" in text


def test_a_monitor_in_text_mode_has_the_screen_as_its_status():
    settings = Monitor.Settings(screen=True, page=False)
    monitor = Monitor(settings, Context("monitor", ManualClock()))
    list(monitor.start())
    assert monitor.status().startswith("sparseskin")
    assert "skin: 0 frames" in monitor.status()


def test_notices_are_at_the_top_and_what_is_bad_stands_out(clock):
    graph = filled(clock)
    assert lines_of(graph)[0].endswith(" live")
    paused = node_state("sensor", condition="paused", commands={"pause": ""})
    graph.feed.update(graph=graph_state(paused | {"state": {"paused": True}}, recording="a.mcap"))
    lines = lines_of(graph)
    assert lines[0].endswith(" live")
    assert lines[1] == "recording a.mcap"
    assert " * sensor is paused." in lines
    clock.advance(0.5)
    graph.feed.update(graph=graph_state(node_state("sensor", condition="not answering")))
    clock.advance(0.5)
    graph.feed.pulse()
    lines = lines_of(graph)
    assert lines[0].startswith("sparseskin  a_graph ")
    assert lines[0].endswith(" FAULT")
    assert lines[1] == "sensor: not answering"
    assert lines[2:4] == ["!! sensor: not answering.", "!! stale: no new frame for 0.5 s."]
