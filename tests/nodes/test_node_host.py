"""Counters of a node: sequence numbers, gaps, repeats, refusals, ends."""

import re

import numpy as np
import pytest

from sparseskin.messages import End, Measurements, PhiState, Taxels, encode
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import RefusedError, SparseskinError
from sparseskin.nodes.node import Context, Node, SourceNode, Tick
from sparseskin.nodes.node_host import NodeHost
from sparseskin.nodes.settings import Settings

RUN = "00000000000000aa"
OTHER_RUN = "00000000000000bb"


def taxels(seq, run_id=RUN, value=1.0):
    forces = np.full((2, 2), value, np.float32)
    return Taxels(stamp_ns=100 + seq, patch="skin", run_id=run_id, seq=seq, forces=forces)


def phi():
    fields = {"kind": "sbhe", "n": 4, "m": 1, "block": 2, "seed": 0, "fingerprint": "0" * 16}
    return PhiState(stamp_ns=0, patch="skin", run_id=RUN, **fields)


def end(n):
    return End(stamp_ns=999, patch="skin", run_id=RUN, seq=n, of="taxels", n_messages=n)


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
            yield Measurements(stamp_ns=message.stamp_ns, patch="skin", y=total, phi="0" * 16)


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
    return NodeHost(cls(Settings(), Context("n", ManualClock())), RUN, lines.append), lines


def test_what_goes_out_is_numbered_and_signed():
    host, _ = make(Summer)
    out = [m for k in range(3) for m in host.receive(taxels(k))]
    assert [(m.run_id, m.seq, m.stamp_ns) for m in out] == [(RUN, k, 100 + k) for k in range(3)]


@pytest.mark.parametrize(
    ("numbers", "n_sent", "lost"), [([0, 1, 2], 3, 0), ([2, 3], 4, 2), ([], 4, 4), ([0, 5], 9, 7)]
)
def test_gaps_are_losses_at_the_start_between_and_at_the_end(numbers, n_sent, lost):
    host, _ = make(Summer)
    for seq in numbers:
        list(host.receive(taxels(seq)))
    list(host.receive(end(n_sent)))
    count = host.counts.inputs["/skin/taxels"]
    assert (count.received, count.lost, count.received + count.lost) == (len(numbers), lost, n_sent)


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
    assert (list(host.receive(taxels(1, value=8.0))), len(list(host.receive(taxels(2))))) == ([], 1)
    assert host.counts.refused == {"refused": 1, "failed": 1}
    refusal, failure = lines
    assert refusal == "refused: too heavy"
    text = r"failed: ZeroDivisionError: a user's own mistake \(.*test_node_host\.py:\d+\)"
    assert re.fullmatch(text, failure)


def test_a_message_that_cannot_be_made_is_an_error_of_its_node():
    class Short(Summer):
        def step(self, message):
            yield Measurements(stamp_ns=-1, patch="skin", y=np.ones(1, np.float32), phi="0" * 16)

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
    assert ([type(m) for m in out], host.failure) == ([Taxels, End], "the driver hung up")
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
    assert (host.failure, host.counts.refused) == ("frame 0 cannot be measured", {"failed": 2})
    assert lines == ["failed: frame 0 cannot be measured"]
