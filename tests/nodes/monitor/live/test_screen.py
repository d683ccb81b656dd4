"""The monitor as text, in lines that fit a terminal of 80 columns, and its notices."""

import numpy as np
import pytest
from bags import PHI
from feeds import FakeTime, Graph, graph_state, node_state

from sparseskin.messages import (
    Measurements,
    PhiState,
    Reason,
    Reconstruction,
    Taxels,
    Truth,
)
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.monitor.live.feed import STALE_S, Feed
from sparseskin.nodes.monitor.live.notices import (
    BAD,
    GRAPH_S,
    NOTE,
    RECENT_S,
    START,
    Notices,
    ago,
    host_lines,
)
from sparseskin.nodes.monitor.live.screen import WIDTH, screen
from sparseskin.nodes.monitor.node import Monitor
from sparseskin.nodes.monitor.table import summary_table
from sparseskin.nodes.node import Context

SHAPE = (4, 6)
STATUS = (
    "skin: 50 frames, 50 Hz, lost 0 | PSNR of contact frames 40.0 dB (taxels 20.0) | "
    * 2
)
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
    fields = {
        "kind": "sbhe",
        "n": 24,
        "m": 8,
        "block": 8,
        "seed": 0,
        "fingerprint": PHI,
    }
    graph.take(PhiState(**head, stamp_ns=0, **fields))
    truth = np.zeros(SHAPE, np.float32)
    truth[1, 4] = 2.0
    noisy, restored = (truth + np.float32(error) for error in ERROR_N)
    rest = {
        "phi": PHI,
        "iterations": 30,
        "residual": 0.0,
        "solve_ns": 2_000_000,
        "done_ns": 0,
    }
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
    table = summary_table("", {"skin": graph.feed.patches["skin"].summary}).split("\n")
    assert lines[-len(table) :] == table
    assert " ".join(lines[: -len(table)]).endswith(STATUS.strip())


def test_a_frame_that_is_not_to_be_trusted_is_marked_for_as_long_as_a_person_needs(
    clock,
):
    graph = filled(clock)
    graph.skin()
    graph.n["skin"] = 50

    def marked(trusted):
        graph.frame(error=0.1, trusted=trusted, reason="" if trusted else "error")
        return f"!! skin: not trusted: {Reason.ERROR.phrase}" in lines_of(graph)

    assert not marked(trusted=True)
    assert marked(trusted=False)
    clock.advance(0.49)
    assert marked(trusted=True)
    clock.advance(0.02)
    assert not marked(trusted=True)


@pytest.mark.parametrize("reason", ["", "uniform", *Reason])
def test_the_mark_of_a_frame_names_its_reason_on_as_many_lines_as_it_needs(
    clock, reason
):
    name = "left_forearm_of_a_body"
    graph = Graph(name)
    graph.skin(name)
    graph.frame(name, trusted=False, reason=reason)
    text = " ".join(" ".join(lines_of(graph)).split())
    phrases = {"": "", "uniform": ': unknown reason "uniform"'}
    phrase = phrases[reason] if reason in phrases else f": {Reason(reason).phrase}"
    assert (
        f"!! {name}: not trusted{phrase} {STATUS}".split()
        == text[text.index("!!") :].split()
    )


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
    unknown = {
        "heard": None,
        "silent": [],
        "clock_offset_ms": None,
        "clock_uncertainty_ms": None,
    }
    graph = filled(clock)
    assert not any(line.startswith("host") for line in lines_of(graph))
    graph.feed.update(graph=graph_state(hosts={"edge": unknown | changes}))
    assert graph.feed.graph is not None
    assert host_lines(graph.feed.graph) == [told]
    assert told[1] in lines_of(graph)


def test_long_names_fit_and_a_monitor_in_text_mode_has_the_screen_as_its_status(clock):
    graph = filled(clock)
    nodes = [
        node_state(f"node_{k}_" + "x" * 24, condition="restarting") for k in range(12)
    ]
    state = graph_state(*nodes, name="n" * 100, recording="r" * 100 + ".mcap")
    graph.feed.update(graph=state)
    graph.skin(source="s" * 200)
    text = "\n".join(lines_of(graph))
    for k in range(12):
        assert f"!! node_{k}_" in text
    settings = Monitor.Settings(screen=True, page=False)
    monitor = Monitor(settings, Context("monitor", ManualClock()))
    list(monitor.start())
    assert monitor.status().startswith("sparseskin")
    assert "skin: 0 frames" in monitor.status()


def test_notices_are_at_the_top_and_what_is_bad_stands_out(clock):
    graph = filled(clock)
    assert lines_of(graph)[0].endswith(" live")
    paused = node_state("sensor", condition="paused", commands={"pause": ""})
    graph.feed.update(
        graph=graph_state(paused | {"state": {"paused": True}}, recording="a.mcap")
    )
    lines = lines_of(graph)
    assert lines[0].endswith(" live")
    assert lines[1] == "recording a.mcap"
    assert " * sensor is paused." in lines
    clock.advance(0.5)
    graph.feed.update(
        graph=graph_state(node_state("sensor", condition="not answering"))
    )
    clock.advance(0.5)
    graph.feed.pulse()
    lines = lines_of(graph)
    assert lines[0].startswith("sparseskin  a_graph ")
    assert lines[0].endswith(" FAULT")
    assert lines[1] == "sensor: not answering"
    assert lines[2:4] == [
        "!! sensor: not answering.",
        "!! stale: no new frame for 0.5 s.",
    ]


PAUSE = {"pause": "acquire no frame"}


class Desk:
    """A person who looks at the notices of a graph that is otherwise alive."""

    def __init__(self, clock, *patches):
        self.clock = clock
        self.graph = Graph(*patches)
        self.feed = self.graph.feed
        self._notices = Notices(self.feed)

    def look(self, after_s=0.0):
        self.clock.advance(after_s)
        self.feed.pulse()
        return self._notices.all(self.clock.now_s)

    def news(self, *nodes):
        self.feed.update(graph=graph_state(*nodes))

    def lose(self, total):
        """A frame comes, and with it how many were lost so far."""
        self.graph.frame()
        self.feed.patches["skin"].lost = total
        return self.look()


@pytest.fixture
def desk(monkeypatch):
    """A desk at which one whole frame has been seen, and nothing is wrong."""
    desk = Desk(FakeTime(monkeypatch))
    desk.graph.skin()
    desk.graph.frame()
    assert desk.look() == []
    return desk


def test_until_frames_are_reconstructed_that_is_reported(monkeypatch):
    desk = Desk(FakeTime(monkeypatch))
    assert desk.look() == [(NOTE, "no frame has arrived yet.")]
    desk.graph.skin()
    assert desk.look() == [(NOTE, "no frame has arrived yet.")]
    desk.graph.frame(upto=1)
    assert desk.look() == []  # the first may still be under way
    desk.graph.frame(upto=1)
    assert desk.look() == [(BAD, "frames are sensed, none is reconstructed.")]


@pytest.mark.parametrize(
    ("rate_hz", "stale_s"), [(0.0, 0.2), (1000.0, 0.2), (5.0, 0.5)]
)
def test_stale_is_older_than_200_ms_and_2_5_periods(monkeypatch, rate_hz, stale_s):
    desk = Desk(FakeTime(monkeypatch))
    desk.graph.skin(rate_hz=rate_hz)
    desk.graph.frame()
    assert desk.look(0.99 * stale_s) == []
    assert desk.look(0.02 * stale_s) == [
        (BAD, f"stale: no new frame for {ago(1.01 * stale_s)}.")
    ]
    desk.graph.frame()
    assert desk.look() == []


def test_frames_that_are_sensed_but_no_longer_reconstructed_are_stale(desk):
    for _ in range(50):
        desk.clock.advance(0.01)
        desk.graph.frame(upto=3)
    assert desk.look() == [
        (BAD, "stale: frames are sensed, none reconstructed for 0.5 s.")
    ]


def test_a_paused_graph_is_not_stale(desk):
    desk.news(
        node_state("sensor", commands=PAUSE, state={"paused": True}, condition="paused")
    )
    assert desk.look(GRAPH_S / 2) == [(NOTE, "sensor is paused.")]
    desk.news(node_state("sensor", commands=PAUSE, state={"paused": False}))
    desk.graph.frame()
    assert desk.look() == []
    desk.news(  # where one of two sources runs, the graph is not paused
        node_state("left", commands=PAUSE, state={"paused": True}, condition="paused"),
        node_state("right", commands=PAUSE, state={"paused": False}),
    )
    assert (BAD, "stale: no new frame for 1.0 s.") in desk.look(1.0)


def test_a_stream_that_has_ended_is_not_stale_until_it_begins_again(desk):
    desk.graph.summarise()
    desk.feed.update(ended="skin")
    assert desk.look(10 * STALE_S) == [(NOTE, "the stream has ended.")]
    desk.graph.frame()
    assert desk.look() == []


def test_lost_frames_are_reported_for_some_seconds(desk):
    assert desk.lose(0) == []
    assert desk.lose(3) == [(BAD, "3 frames lost just now.")]
    desk.clock.advance(0.9 * RECENT_S)
    assert desk.lose(3) == [(BAD, "3 frames lost just now.")]
    desk.clock.advance(0.2 * RECENT_S)
    assert desk.lose(3) == []
    assert desk.lose(4) == [(BAD, "1 frame lost just now.")]
    assert desk.lose(0) == []  # another run counts from 0
    assert desk.lose(2) == [(BAD, "2 frames lost just now.")]


def test_refusals_are_reported_for_some_seconds_with_their_reason(desk):
    def refuse(count, reason, after_s=0.0):
        desk.clock.advance(after_s)
        desk.news(node_state("reconstructor", refused=count, refusal=reason))
        desk.graph.frame()
        return desk.look()

    assert refuse(0, "") == []
    told = [(BAD, "reconstructor rejects messages: refused: Phi mismatch")]
    assert refuse(1, "refused: Phi mismatch") == told
    assert refuse(1, "refused: Phi mismatch", 0.9 * RECENT_S) == told
    assert refuse(1, "refused: Phi mismatch", 0.2 * RECENT_S) == []
    assert refuse(2, "refused: another") == [
        (BAD, "reconstructor rejects messages: refused: another")
    ]


def test_a_node_in_trouble_is_named_as_long_as_it_is_and_a_restart_noted_for_some_seconds(
    desk,
):
    def news(restarts, condition, after_s=0.0):
        desk.clock.advance(after_s)
        desk.news(node_state("sensor", restarts=restarts, condition=condition))
        desk.graph.frame()
        return desk.look()

    assert news(0, "running") == []
    for _ in range(2):  # as long as it is
        assert news(0, "not answering", 2 * RECENT_S) == [
            (BAD, "sensor: not answering.")
        ]
    assert news(1, "restarting") == [(BAD, "sensor: restarting.")]
    assert news(1, "running", 1.0) == [(NOTE, "sensor was restarted.")]
    assert news(1, "running", RECENT_S) == []


def test_the_start_of_a_graph_is_no_fault_and_is_counted_until_all_nodes_run(desk):
    def news(*conditions, compiled=None, restarts=0):
        desk.news(
            *(
                node_state(
                    f"node_{k}", condition=word, compiled=compiled, restarts=restarts
                )
                for k, word in enumerate(conditions)
            )
        )
        return Notices(desk.feed).all(desk.clock.advance(0.0))

    assert news("running", "starting") == [(START, "starting: 1 of 2 nodes")]
    line = "starting: compiling once for this installation, 3 of 10"
    assert news("starting", "running", compiled=(3, 10)) == [(START, line)]
    assert (
        screen(desk.feed, Notices(desk.feed), "").split("\n")[0].endswith(" starting")
    )
    assert (START, line) not in news("running", "running")
    assert desk.feed.start is None

    # Later on, one that joins is no news, and one that is started again is trouble.
    assert not [text for _, text in news("running", "starting") if "starting" in text]
    assert (BAD, "node_1: starting.") in news("running", "starting", restarts=1)


def test_old_news_and_a_busy_monitor_are_reported(desk):
    desk.news(node_state("sensor"))
    desk.clock.advance(0.99 * GRAPH_S)
    desk.graph.frame()
    assert desk.look() == []
    desk.clock.advance(10.0)
    desk.graph.frame()
    assert desk.look() == [(BAD, "No state of the nodes has arrived for 12 s.")]
    now_s = desk.clock.advance(3.0)
    assert Notices(desk.feed).all(now_s)[0] == (
        BAD,
        "The monitor has not responded for 3.0 s.",
    )


def test_measurements_that_are_left_out_are_reported_while_they_are(desk):
    left_out = "faulty measurements left out: 2 of 533 (3, 100)"
    desk.news(node_state("reconstructor", state={"left_out": left_out}))
    assert desk.look() == [(NOTE, f"reconstructor: {left_out}.")]
    desk.news(node_state("reconstructor", state={"left_out": ""}))
    assert desk.look() == []


def test_notices_of_many_patches_that_differ_in_numbers_alone_are_one():
    feed = Feed(tuple(f"p{k}" for k in range(6)))
    texts = [text for _, text in Notices(feed).all(feed.pulse_s)]
    assert texts == ["p0 and 5 other patches: no frame has arrived yet."]
    few = Feed(("palm", "sole"))
    told = [f"{patch}: no frame has arrived yet." for patch in ("palm", "sole")]
    assert [text for _, text in Notices(few).all(few.pulse_s)] == told
