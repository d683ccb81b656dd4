"""Counters of a node: sequence numbers, gaps, repeats, refusals, ends."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages import End, Measurements, PhiState, Taxels, encode
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import RefusedError, SparseskinError
from sparseskin.nodes.node import Context, Node, SourceNode, Tick
from sparseskin.nodes.node_host import NodeHost, TopicCount
from sparseskin.nodes.settings import Settings

RUN = "00000000000000aa"
OTHER_RUN = "00000000000000bb"


def taxels(seq, run_id=RUN, value=1.0):
    forces = np.full((2, 2), value, np.float32)
    return Taxels(
        stamp_ns=100 + seq, patch="skin", run_id=run_id, seq=seq, forces=forces
    )


def phi():
    fields = {
        "kind": "sbhe",
        "n": 4,
        "m": 1,
        "block": 2,
        "seed": 0,
        "fingerprint": "0" * 16,
    }
    return PhiState(stamp_ns=0, patch="skin", run_id=RUN, **fields)


def end(n):
    return End(stamp_ns=999, patch="skin", run_id=RUN, seq=n, of="taxels", n_messages=n)


END_AT_0 = {"stamp_ns": 0, "patch": "skin", "run_id": RUN}


class Summer(Node[Settings]):
    """Measures the sum of all taxels; refuses what is above 10."""

    steps = 0

    @classmethod
    def inputs(cls, settings):
        return ("/skin/taxels", "/skin/phi")

    @classmethod
    def outputs(cls, settings):
        return ("/skin/measurements",)

    def step(self, message):
        self.steps += 1
        if isinstance(message, Taxels):
            total = message.forces.sum(keepdims=True).reshape(1)
            if total > 40:
                raise RefusedError("too heavy")
            if total > 20:
                raise ZeroDivisionError("a user's own mistake")
            yield Measurements(
                stamp_ns=message.stamp_ns, patch="skin", y=total, phi="0" * 16
            )


class Counter(SourceNode[Settings]):
    """Three frames, then nothing."""

    fails_at = 99

    @classmethod
    def outputs(cls, settings):
        return ("/skin/taxels",)

    def tick(self, tick):
        if tick.index == self.fails_at:
            raise SparseskinError("the driver hung up")
        yield taxels(7)
        self.exhausted = tick.index == 2


def make(cls):
    lines = []
    return NodeHost(
        cls(Settings(), Context("n", ManualClock())), RUN, lines.append
    ), lines


def test_what_goes_out_is_numbered_and_signed():
    host, _ = make(Summer)
    out = [m for k in range(3) for m in host.receive(taxels(k))]
    assert [(m.run_id, m.seq, m.stamp_ns) for m in out] == [
        (RUN, k, 100 + k) for k in range(3)
    ]


@pytest.mark.parametrize(
    ("numbers", "n_sent", "lost"),
    [([0, 1, 2], 3, 0), ([2, 3], 4, 2), ([], 4, 4), ([0, 5], 9, 7)],
)
def test_gaps_are_losses_at_the_start_between_and_at_the_end(numbers, n_sent, lost):
    host, _ = make(Summer)
    for seq in numbers:
        list(host.receive(taxels(seq)))
    list(host.receive(end(n_sent)))
    count = host.counts.inputs["/skin/taxels"]
    assert (count.received, count.lost, count.received + count.lost) == (
        len(numbers),
        lost,
        n_sent,
    )


def test_a_repeated_message_is_taken_once_and_a_publisher_that_starts_again_is_no_loss():
    host, _ = make(Summer)
    for message in (phi(), phi(), taxels(0), taxels(0), taxels(1)):
        list(host.receive(message))
    assert (host.node.steps, host.counts.inputs["/skin/phi"].received) == (3, 1)
    host, _ = make(Summer)
    for message in (taxels(0), taxels(1), taxels(0, OTHER_RUN), taxels(1, OTHER_RUN)):
        list(host.receive(message))
    count = host.counts.inputs["/skin/taxels"]
    assert (count.received, count.lost) == (4, 0)


def test_refused_and_failed_messages_end_no_node():
    host, lines = make(Summer)
    assert list(host.receive(taxels(0, value=100.0))) == []
    assert (
        list(host.receive(taxels(1, value=8.0))),
        len(list(host.receive(taxels(2)))),
    ) == ([], 1)
    assert host.counts.refused == {"refused": 1, "failed": 1}
    refusal, failure = lines
    assert refusal == "refused: too heavy"
    text = (
        r"failed: ZeroDivisionError: a user's own mistake \(.*test_node_host\.py:\d+\)"
    )
    assert re.fullmatch(text, failure)


def test_a_message_that_cannot_be_made_is_an_error_of_its_node():
    class Short(Summer):
        def step(self, message):
            yield Measurements(
                stamp_ns=-1, patch="skin", y=np.ones(1, np.float32), phi="0" * 16
            )

    host, lines = make(Short)
    raised = []
    host.raised = raised.append
    assert list(host.receive(taxels(0))) == []
    assert host.counts.errors == len(raised) == 1
    assert "not published" in lines[0]


def test_a_flood_of_refusals_is_counted_whole_but_said_seldom():
    host, lines = make(Summer)
    for seq in range(1000):
        list(host.receive(taxels(seq, value=100.0)))
    assert host.counts.refused["refused"] == 1000
    assert len(lines) == 4  # the 1st, 10th, 100th and 1000th


def test_what_is_no_message_of_an_input_is_counted_by_reason():
    host, _ = make(Summer)
    topic, payload = encode(taxels(0))
    for wrong in (payload[:-1], b"", b"\x01", payload + b"\0"):
        assert list(host.receive_bytes(topic, wrong)) == []
    assert len(list(host.receive_bytes(topic, payload))) == 1
    stray = Taxels(stamp_ns=0, patch="other", forces=np.zeros((1, 1), np.float32))
    assert list(host.receive(stray)) == []
    assert host.counts.refused == {"truncated": 2, "malformed": 2, "unknown topic": 1}


def test_the_end_of_all_streams_is_passed_on_once_with_the_count():
    host, _ = make(Summer)
    for seq in range(3):
        list(host.receive(taxels(seq)))
    (last,) = host.receive(end(3))
    assert (last.topic, last.n_messages) == ("/skin/measurements", 3)
    assert host.finished
    assert list(host.receive(end(3))) == []


def test_a_source_ends_with_its_last_frame_or_with_its_failure():
    host, _ = make(Counter)
    out = [m for k in range(3) for m in host.tick(Tick(k, k))]
    assert [type(m) for m in out] == [Taxels, Taxels, Taxels, End]
    assert [m.seq for m in out] == [0, 1, 2, 3]
    host, lines = make(Counter)
    host.node.fails_at = 1
    out = [m for k in range(2) for m in host.tick(Tick(k, k))]
    assert ([type(m) for m in out], host.failure) == (
        [Taxels, End],
        "the driver hung up",
    )
    assert lines == ["error: the driver hung up"]


class Impossible(Summer):
    """A node that cannot do what its settings ask for."""

    def step(self, message):
        raise SparseskinError(f"frame {message.seq} cannot be measured")


def test_the_first_failure_of_a_node_is_its_reason():
    host, lines = make(Impossible)
    assert host.failure == ""
    for seq in range(2):
        assert list(host.receive(taxels(seq))) == []
    assert (host.failure, host.counts.refused) == (
        "frame 0 cannot be measured",
        {"failed": 2},
    )
    assert lines == ["failed: frame 0 cannot be measured"]


@given(first=st.integers(0, 99), n_lost=st.integers(0, 9))
def test_a_late_reader_loses_nothing_before_its_first_message(first, n_lost):
    count = TopicCount(late=True)
    assert count.admit(taxels(first))
    assert count.lost == 0
    assert count.total == 1
    count.end(RUN, first + 1 + n_lost)
    assert count.lost == n_lost
    assert count.total == 1 + n_lost


@pytest.mark.parametrize(("late", "lost"), [(True, 0), (False, 7)])
def test_of_a_stream_that_ends_unread_a_late_reader_has_lost_nothing(late, lost):
    count = TopicCount(late=late)
    count.end(RUN, 7)
    assert count.lost == lost
    assert count.ended


def test_messages_of_all_runs_of_a_publisher_are_counted():
    count = TopicCount()
    for message in (taxels(0), taxels(1), taxels(0, OTHER_RUN)):
        count.admit(message)
    assert count.total == 3
    assert count.received == 3


def test_a_publisher_that_starts_again_after_its_end_has_not_ended():
    count = TopicCount()
    count.end(RUN, 2)
    assert count.ended
    count.admit(taxels(0, OTHER_RUN))
    assert not count.ended
    assert count.lost == 2


def test_states_that_a_reader_has_not_seen_are_not_lost():
    count = TopicCount()
    assert count.admit(phi().published(RUN, 4))
    assert count.lost == 0


def test_the_end_of_an_input_is_processed_once():
    class Ending(Summer):
        n_ends = 0

        def ended(self, topic, n_messages):
            self.n_ends += 1
            return ()

    host, _ = make(Ending)
    for _ in range(3):
        list(host.receive(end(0)))
    assert host.node.n_ends == 1


def test_errors_are_counted_beside_refusals():
    host, _ = make(Summer)
    assert "errors" not in host.counts.as_dict()
    list(host.receive(taxels(0, value=8.0)))
    list(host.receive(taxels(1, value=100.0)))
    counts = host.counts.as_dict()
    assert counts["errors"] == 1
    assert counts["refused"] == {"failed": 1, "refused": 1}
    assert counts["received"] == {"/skin/taxels": 2, "/skin/phi": 0}
    assert counts["published"] == {}


def test_an_overtaken_message_is_skipped_and_an_overtaken_end_ends():
    host, _ = make(Summer)
    assert list(host.receive(taxels(0), overtaken=True)) == []
    assert host.node.steps == 0
    assert host.counts.inputs["/skin/taxels"].skipped == 1
    assert host.counts.inputs["/skin/taxels"].lost == 0
    (last,) = host.receive(end(1), overtaken=True)
    assert isinstance(last, End)


@pytest.mark.parametrize("method", ["idle", "close"])
def test_a_node_that_fails_between_messages_states_why(method):
    class Failing(Summer):
        def idle(self):
            raise SparseskinError("the disk is full")

        def close(self, counts):
            raise SparseskinError("the disk is full")

    host, lines = make(Failing)
    getattr(host, method)()
    assert host.failure == "the disk is full"
    assert lines == ["failed: the disk is full"]
    assert host.counts.refused == {"failed": 1}


def test_the_end_has_the_latest_stamp_of_the_inputs():
    host, _ = make(Summer)
    for seq in (0, 5, 3):
        list(host.receive(taxels(seq)))
    (last,) = host.receive(End(**END_AT_0, seq=6, of="taxels", n_messages=6))
    assert last.stamp_ns == 105


def test_a_source_that_is_ended_publishes_what_is_still_to_come():
    class Delayed(Counter):
        def rest(self):
            yield taxels(0)

    host, _ = make(Delayed)
    list(host.tick(Tick(0, 0)))
    rest, last = host.finish_frames(7)
    assert (type(rest), rest.seq) == (Taxels, 1)
    assert (type(last), last.n_messages) == (End, 2)
    assert list(host.finish_frames(8)) == []
