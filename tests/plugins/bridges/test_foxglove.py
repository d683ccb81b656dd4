"""The bridge to Foxglove, seen by a client of its protocol that shares no code with its SDK."""

from dataclasses import replace

import numpy as np
import pytest
from bags import frame, skin_state
from conftest import wait_until
from foxglove_client import FoxgloveClient, pixels

from sparseskin.messages import Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.node import Context

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
from sparseskin.plugins.bridges.foxglove import FoxgloveBridge, FoxgloveSettings

TOPIC = "/skin/taxels"
ROWS = 5
COLS = 8
"""Neither equal nor powers of two: a transposed or padded image is noticed."""


SKIN = skin_state(n_rows=ROWS, n_cols=COLS, mask=None)


def taxels(k):
    forces = np.random.default_rng(k).random((ROWS, COLS)).astype(np.float32)
    stamp_ns = 1_700_000_000_000_000_000 + k
    return Taxels(stamp_ns=stamp_ns, patch="skin", forces=forces).published("0" * 16, k)


@pytest.fixture
def bridge():
    made = FoxgloveBridge(FoxgloveSettings(port=0), Context("foxglove", ManualClock(0)))
    assert not list(made.start())
    yield made
    made.close({})


def subscribed(bridge, *topics):
    client = FoxgloveClient(bridge.where())
    client.wait_for_channels(*topics)
    client.subscribe(*topics)
    wait_until(
        lambda: all(bridge._channels[topic].has_sinks() for topic in topics), "sinks"
    )
    return client


def test_each_frame_arrives_with_its_pixels_and_stamp(bridge):
    sent = [taxels(k) for k in range(200)]
    with subscribed(bridge, TOPIC) as client:
        for message in (SKIN, *sent):
            list(bridge.step(message))
        for message in sent:
            got = client.data()
            assert got.log_time_ns == message.stamp_ns
            assert np.array_equal(pixels(got.content), message.forces[0])
            stamp = got.content.timestamp
            assert stamp.seconds * 10**9 + stamp.nanos == message.stamp_ns


def test_a_frame_that_was_not_solved_has_the_forces_of_the_one_before(bridge):
    solved = replace(frame(0)[3], seq=1)
    idle = replace(
        solved, seq=2, stamp_ns=1, forces=solved.forces[:0], unchanged=(True,)
    )
    with subscribed(bridge, solved.topic) as client:
        for message in (skin_state(), replace(idle, seq=0), solved, idle):
            list(bridge.step(message))
        for stamp_ns in (0, 1):
            got = client.data()
            assert got.log_time_ns == stamp_ns
            assert np.array_equal(pixels(got.content), solved.forces[0])


def test_frames_of_another_shape_are_not_sent_and_a_taken_port_is_refused(bridge):
    list(bridge.step(taxels(0)))
    list(bridge.step(SKIN))
    other = Taxels(stamp_ns=1, patch="skin", forces=np.zeros((COLS, ROWS), np.float32))
    list(bridge.step(other))
    assert bridge.n_sent == 0
    port = int(bridge.where().rpartition(":")[2])
    with pytest.raises(
        SettingsError, match=rf"port: cannot listen at 127.0.0.1:{port}"
    ):
        FoxgloveBridge(FoxgloveSettings(port=port), Context("two", ManualClock(0)))


def test_hostile_requests_end_neither_server_nor_bridge(bridge):
    with FoxgloveClient(bridge.where()) as client:
        info = client.receive()
        # neither parameters nor messages of clients
        assert info["capabilities"] == ["time"]
        for text in (
            "",
            "[]",
            "{",
            '{"op": 5}',
            '{"op": "subscribe", "subscriptions": 3}',
        ):
            client._socket.send(text)
        client._socket.send(b"\xff" * 100)
        client.send(op="subscribe", subscriptions=[{"id": 1, "channelId": 2**31}])
        client.send(
            op="setParameters", parameters=[{"name": "x" * 5000, "value": [[[1]]]}]
        )
        client.wait_for_channels(TOPIC)
        client.subscribe(TOPIC)
        wait_until(lambda: bridge._channels[TOPIC].has_sinks(), "the subscription")


@pytest.mark.slow
def test_a_client_reads_frames_of_a_running_graph(start):
    graph = start(
        "launch", "path_40", "--set", "monitor.page=false", "--set", "sensor.rate_hz=20"
    )
    graph.wait_for("ready")
    beside = start("bridge", "foxglove", "--port", "0")
    with FoxgloveClient(beside.wait_for("foxglove: ")) as client:
        client.wait_for_channels("/skin/reconstruction")
        client.subscribe("/skin/reconstruction")
        assert pixels(client.data().content).shape == (40, 40)
