"""Notices: shown while a fault lasts, and no longer."""

import pytest
from feeds import FakeTime, Graph, graph_state, node_state

from sparseskin.nodes.monitor.live.feed import STALE_S, Feed
from sparseskin.nodes.monitor.live.notices import BAD, GRAPH_S, NOTE, RECENT_S, Notices, ago

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


@pytest.mark.parametrize(("rate_hz", "stale_s"), [(0.0, 0.2), (1000.0, 0.2), (5.0, 0.5)])
def test_stale_is_what_is_older_than_200_ms_and_than_two_and_a_half_periods(
    monkeypatch, rate_hz, stale_s
):
    desk = Desk(FakeTime(monkeypatch))
    desk.graph.skin(rate_hz=rate_hz)
    desk.graph.frame()
    assert desk.look(0.99 * stale_s) == []
    assert desk.look(0.02 * stale_s) == [(BAD, f"stale: no new frame for {ago(1.01 * stale_s)}.")]
    desk.graph.frame()
    assert desk.look() == []


def test_frames_that_are_sensed_but_no_longer_reconstructed_are_stale(desk):
    for _ in range(50):
        desk.clock.advance(0.01)
        desk.graph.frame(upto=3)
    assert desk.look() == [(BAD, "stale: frames are sensed, none reconstructed for 0.5 s.")]


def test_a_paused_graph_is_not_stale(desk):
    desk.news(node_state("sensor", commands=PAUSE, state={"paused": True}, condition="paused"))
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


def test_a_node_in_trouble_is_named_as_long_as_it_is_and_a_restart_noted_for_some_seconds(desk):
    def news(restarts, condition, after_s=0.0):
        desk.clock.advance(after_s)
        desk.news(node_state("sensor", restarts=restarts, condition=condition))
        desk.graph.frame()
        return desk.look()

    assert news(0, "running") == []
    for _ in range(2):  # as long as it is
        assert news(0, "not answering", 2 * RECENT_S) == [(BAD, "sensor: not answering.")]
    assert news(1, "restarting") == [(BAD, "sensor: restarting.")]
    assert news(1, "running", 1.0) == [(NOTE, "sensor was restarted.")]
    assert news(1, "running", RECENT_S) == []


def test_old_news_of_the_graph_is_reported_with_its_age(desk):
    desk.news(node_state("sensor"))
    desk.clock.advance(0.99 * GRAPH_S)
    desk.graph.frame()
    assert desk.look() == []
    desk.clock.advance(10.0)
    desk.graph.frame()
    assert desk.look() == [(BAD, "No state of the nodes has arrived for 12 s.")]


def test_a_monitor_that_is_busy_reports_it_first(desk):
    now_s = desk.clock.advance(3.0)
    assert Notices(desk.feed).all(now_s)[0] == (BAD, "The monitor has not responded for 3.0 s.")


def test_measurements_that_are_left_out_are_reported_while_they_are(desk):
    left_out = "faulty measurements left out: 2 of 533 (3, 100)"
    desk.news(node_state("reconstructor", state={"left_out": left_out, "swamped": False}))
    assert desk.look() == [(NOTE, f"reconstructor: {left_out}.")]
    desk.news(node_state("reconstructor", state={"left_out": "", "swamped": True}))
    assert desk.look() == [(BAD, "reconstructor: too many measurements are inconsistent.")]
    desk.news(node_state("reconstructor", state={"left_out": "", "swamped": False}))
    assert desk.look() == []


def test_notices_of_many_patches_that_differ_in_numbers_alone_are_one():
    feed = Feed(tuple(f"p{k}" for k in range(6)))
    texts = [text for _, text in Notices(feed).all(feed.pulse_s)]
    assert texts == ["p0 and 5 other patches: no frame has arrived yet."]
    few = Feed(("palm", "sole"))
    told = [f"{patch}: no frame has arrived yet." for patch in ("palm", "sole")]
    assert [text for _, text in Notices(few).all(few.pulse_s)] == told
