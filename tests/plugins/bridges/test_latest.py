"""The newest frame of a running graph, read beside it."""

import time
import uuid
from dataclasses import replace

import numpy as np
import pytest
from bags import frame, skin_state
from conftest import wait_until
from exported import contacts
from processes import announced

from sparseskin.launch.run.running import GraphError, RunningGraph, RunningNode
from sparseskin.nodes.network.sockets import Writer, make_context
from sparseskin.plugins.bridges.latest import LatestFrames

TOPICS = ["/skin/skin", "/skin/reconstruction", "/skin/contacts"]


def solved(k):
    return frame(k)[3]


@pytest.fixture
def publisher(tmp_path, monkeypatch):
    """The writer of a graph, "touched"."""
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path))
    context = make_context()
    writer = Writer(context, f"ipc://@sparseskin-{uuid.uuid4().hex}", "host")
    nodes = {"host": RunningNode("reconstructor", writer.endpoint, TOPICS)}
    with announced(RunningGraph("touched", 1, time.time_ns() - time.monotonic_ns(), "", nodes)):
        yield writer
    context.destroy(linger=0)


@pytest.fixture
def reader(publisher):
    made = LatestFrames(None, "skin", with_contacts=True)
    assert made.newest() is None

    def subscribed():
        publisher.serve_subscriptions()
        send(publisher, 0, skin_state(), solved(0), contacts(0))
        return made.newest() is not None

    wait_until(subscribed, "the subscriptions")
    yield made
    made.close()


def send(writer, seq, *messages):
    for message in messages:
        writer.send(message.published("0" * 16, seq))


def frame_of(reader, k):
    """Frame k, and none between it and those that came before."""
    after = 0
    while True:
        found = reader.newest(after, timeout_s=60)
        if found.frame.stamp_ns == solved(k).stamp_ns:
            return found
        assert found.frame.stamp_ns == 0
        after = found.number


def test_a_frame_comes_with_its_contacts_and_each_once(publisher, reader):
    send(publisher, 1, solved(1), contacts(2), contacts(1))  # contacts of another frame, too
    found = frame_of(reader, 1)
    assert found.contacts.stamp_ns == found.frame.stamp_ns
    assert np.array_equal(found.frame.forces, solved(1).forces)
    assert reader.newest(after=found.number) is None


def test_forces_that_a_frame_refers_to_are_those_of_the_frame_before_or_none(publisher, reader):
    def idle(k):
        return replace(solved(k), forces=solved(k).forces[:0], unchanged=(True,))

    send(publisher, 1, solved(1), contacts(1))
    first = frame_of(reader, 1).number
    send(publisher, 2, idle(2), contacts(2))
    found = reader.newest(first, timeout_s=60)
    assert np.array_equal(found.frame.forces, solved(1).forces)
    send(publisher, 4, idle(4), contacts(4))  # one is lost
    send(publisher, 5, solved(5), contacts(5))
    found = reader.newest(first + 1, timeout_s=60)
    assert (found.number, found.frame.stamp_ns) == (first + 2, solved(5).stamp_ns)


def test_of_a_batch_one_patch_is_read_by_its_name(publisher, reader):
    one, found = solved(1), contacts(1)
    of_both = dict.fromkeys(("error", "trusted", "unchanged", "reason"), ())
    of_both |= {name: 2 * getattr(one, name) for name in ("iterations", "residual", "solve_ns")}
    forces = np.concatenate([one.forces, 2 * one.forces])
    batch = {"names": ("a", "b")}
    touched = replace(found, **batch, trusted=(), patch_of=np.ones(1, np.int32), events=None)
    both = replace(one, **batch, forces=forces, **of_both), touched
    other = LatestFrames(None, "skin/b", with_contacts=True)

    def came():
        publisher.serve_subscriptions()
        send(publisher, 1, skin_state(), *both)
        return other.newest() is not None

    wait_until(came, "a frame")
    latest = other.newest()
    assert latest.frame.forces.tolist() == forces[1:].tolist()
    assert (latest.contacts.patch, latest.contacts.id.tolist()) == ("b", [1])
    other.close()
    with pytest.raises(GraphError, match="/skin/reconstruction: patch: skin/a is one of 2"):
        reader.newest(after=10**9, timeout_s=60)


def test_a_graph_without_contacts_is_one_line(publisher):
    nodes = {"host": RunningNode("reconstructor", publisher.endpoint, TOPICS[:2])}
    with (
        announced(RunningGraph("silent", 2, 0, "", nodes)),
        pytest.raises(
            GraphError, match=r"no /skin/contacts; start it with reconstructor\.contacts=true"
        ),
    ):
        LatestFrames("silent", "skin", with_contacts=True)
