"""Contacts as other tools take them; a bridge observes, and the graph runs as without it."""

import json
import os
import signal
import time
import uuid
from dataclasses import replace

import numpy as np
import pytest
from bags import frame, skin_state
from conftest import note_of_graph, wait_until
from exported import contacts
from processes import announced

from sparseskin.launch.attach.client import describe
from sparseskin.launch.run.running import (
    GraphError,
    RunningGraph,
    RunningNode,
    choose_graph,
)
from sparseskin.messages import Contacts, Reconstruction
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.network.sockets import Reader, Writer, make_context
from sparseskin.nodes.node import Context
from sparseskin.plugins.bridges.base import Bridge, BridgeSettings
from sparseskin.plugins.bridges.contacts import (
    STATE,
    shapes,
    state,
    state_names,
    wrench,
)
from sparseskin.plugins.bridges.latest import LatestFrames


def made(totals, trusted=True, **more):
    """Contacts at rows 0, 1, ... of column 2."""
    n = len(totals)
    total = np.array(totals, np.float32)
    centre = np.stack([np.arange(n), np.full(n, 2)], axis=1).astype(np.float32)
    return Contacts(
        **{"stamp_ns": 0, "patch": "skin", "done_ns": 0, "trusted": trusted},
        id=np.arange(1, n + 1, dtype=np.int32),
        area=np.full(n, 9, np.int32),
        **dict.fromkeys(("total", "total_sd", "peak", "age_s"), total),
        **dict.fromkeys(("centre", "centre_sd", "velocity"), centre),
        **dict.fromkeys(("over", "sliding"), np.zeros(n, np.bool_)),
        **more,
    )


def test_a_wrench_is_the_sum_of_forces_into_the_skin_and_of_their_torques():
    places = np.array([[1000, 0, 0], [0, 2000, 0]], np.float32)
    force, torque = wrench(made([2.0, 3.0], place_mm=places))
    assert force.tolist() == [0, 0, -5]  # of a flat skin, whose z axis points outwards
    assert torque.tolist() == [2 * -3, 1 * 2, 0]
    normals = np.array([[1, 0, 0], [0, 0, -1]], np.float32)
    force, torque = wrench(made([2.0, 3.0], place_mm=places, normal=normals))
    assert force.tolist() == [-2, 0, 3]
    assert torque.tolist() == [6, 0, 0]
    assert not np.any(wrench(made([])))


class Listed(Bridge[BridgeSettings]):
    """A bridge that lists what it sends."""

    Settings = BridgeSettings

    def __init__(self):
        super().__init__(BridgeSettings(), Context("bridge", ManualClock(1), print))
        self.seen = []

    def send(self, message, skin):
        is_map = isinstance(message, Reconstruction)
        self.seen.append(
            (message.topic, message.forces.max() if is_map else message.id.size)
        )


def test_a_bridge_sends_patches_of_a_batch_and_no_forces_of_before_a_lost_frame():
    bridge = Listed()
    skin = skin_state()
    two = {"names": ("left", "right"), "patch": "skin"}
    forces = np.stack([np.full(skin.skin.shape, force, np.float32) for force in (1, 2)])
    head = {
        **two,
        "phi": "0" * 16,
        "iterations": (1, 1),
        "residual": (0.0, 0.0),
        "done_ns": 0,
    }
    sent = Reconstruction(**head, stamp_ns=0, solve_ns=(1, 1), forces=forces)
    idle = replace(sent, forces=forces[:1], unchanged=(False, True))
    touched = replace(made([1.0]), **two, trusted=(), patch_of=np.ones(1, np.int32))
    for message in (skin, sent, touched, replace(idle, seq=1), replace(idle, seq=3)):
        bridge.step(message)
    maps = [("/left/reconstruction", 1.0), ("/right/reconstruction", 2.0)]
    assert bridge.seen == [
        *maps,
        ("/left/contacts", 0),
        ("/right/contacts", 1),
        *maps,
        maps[0],
    ]
    assert bridge.n_dropped == 0


def test_shapes_point_at_contacts_on_points_along_the_force():
    points = np.zeros((34, 6), np.float32)
    points[:, 0] = np.linspace(0, 0.5, 34)
    points[:, 5] = 1
    skin = skin_state(points=points, pitch_m=0.01)
    normal = np.array([[0, 1, 0]], np.float32)
    (one,) = shapes(
        made([5.0], place_mm=np.full((1, 3), 30, np.float32), normal=normal), skin
    )
    assert one.centre == pytest.approx([0.03, 0.03, 0.03])
    # as long as the skin: 25 N
    assert one.tail - one.centre == pytest.approx([0, 0.5 * 5 / 25, 0])
    assert one.diameter == pytest.approx(0.03)


def test_the_state_has_the_strongest_contacts_first_and_zeros_where_there_are_fewer():
    names = state_names("palm", 2)
    assert names[:2] == ["palm.trusted", "palm.contact_1.total"]
    places = np.arange(9, dtype=np.float32).reshape(3, 3)
    mm2 = np.array([7, 8, 9], np.float32)
    three = made([1, 4, 3], place_mm=places, velocity_mm_s=-places, area_mm2=mm2)
    found = dict(zip(names, state(three, 2).tolist(), strict=True))
    at = {
        name: found[f"palm.contact_1.{name}"]
        for name in ("total", "x", "y_velocity", "area")
    }
    assert at == {"total": 4, "x": 3, "y_velocity": -4, "area": 8}
    assert found["palm.contact_2.total"] == 3
    one = state(made([6.0], trusted=False), 2)
    assert one[: 1 + len(STATE)].tolist() == [0, 6, 6, 2, 0, 0, 2, 0, 0, 9, 6]  # taxels
    assert not one[1 + len(STATE) :].any()


def test_a_writer_waits_for_the_presence_of_an_observer_but_not_for_its_answers(
    tmp_path,
):
    context = make_context()
    try:
        endpoint = f"ipc://{tmp_path / 'w'}"
        writer = Writer(context, endpoint, "sensor")
        readers = [
            Reader(context, "solver", [endpoint], ["/skin/taxels"]),
            Reader(context, "bridge", [endpoint], ["/skin/taxels"], observes=True),
        ]
        while writer.present != {"solver", "bridge"}:
            writer.socket.poll(100)
            writer.serve_subscriptions()
        ask = writer.ask()
        assert writer.awaits(ask)
        note = None
        while note is None:
            note = readers[0].receive()
        readers[0].answer(note[1])
        while writer.awaits(ask):
            writer.socket.poll(100)
            writer.serve_subscriptions()
        assert readers[1].receive() is None
    finally:
        context.destroy(linger=0)


@pytest.mark.slow
def test_a_stopped_bridge_holds_up_no_source_that_follows_its_readers(
    start, tmp_path, monkeypatch
):
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
    (tmp_path / "observed.toml").write_text(
        """
[nodes]
sensor = { type = "sensor", source = "scene:path_40", rate_hz = 0 }
compressor.type = "compressor"
reconstructor = { type = "reconstructor", iterations = 1 }
monitor = { type = "monitor", page = false }
fox = { type = "foxglove", port = 0 }
"""
    )
    graph = start(
        *("launch", "observed.toml", "--frames", "1200", "--summary", "out.json"),
        environment={"SPARSESKIN_FAST": "auto"},
    )
    graph.wait_for("ready")
    os.kill(graph.pid_of("fox"), signal.SIGSTOP)
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(graph.notes))
    note_of_graph(graph.notes)
    found = choose_graph(None)

    def sensor_has_ended():
        return ("sensor", "ended") in {
            (n["name"], n["condition"]) for n in describe(found)["nodes"]
        }

    wait_until(sensor_has_ended, "the end of the sensor")
    os.kill(graph.pid_of("fox"), signal.SIGCONT)
    assert graph.finish()[0] == 0
    summary = json.loads((tmp_path / "out.json").read_text())
    assert summary["patches"]["skin"]["frames"]["reconstructed"] == 1200
    fox = summary["nodes"]["fox"]
    # Of each topic: what was sent, or dropped by the bridge, or by the queue of its writer.
    for topic in ("/skin/taxels", "/skin/truth", "/skin/reconstruction"):
        assert fox["received"][topic] + fox["lost"][topic] == 1200
    streams = sum(
        fox["received"][topic] for topic in fox["received"] if topic != "/skin/skin"
    )
    assert fox["bridge"]["sent"] + fox["bridge"]["dropped"] == streams


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"maps": ["taxel"]}, "did you mean 'taxels'"),
        ({"maps": []}, "at least one"),
        ({"depth": 0}, "depth: 0 is outside 1..1000"),
    ],
)
def test_settings_that_make_no_sense_are_refused(values, fault):
    with pytest.raises(SettingsError, match=fault):
        BridgeSettings.from_mapping(values)


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
    with announced(
        RunningGraph("touched", 1, time.time_ns() - time.monotonic_ns(), "", nodes)
    ):
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
    # contacts of another frame, too
    send(publisher, 1, solved(1), contacts(2), contacts(1))
    found = frame_of(reader, 1)
    assert found.contacts.stamp_ns == found.frame.stamp_ns
    assert np.array_equal(found.frame.forces, solved(1).forces)
    assert reader.newest(after=found.number) is None


def test_forces_that_a_frame_refers_to_are_those_of_the_frame_before_or_none(
    publisher, reader
):
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
    assert found.number == first + 2
    assert found.frame.stamp_ns == solved(5).stamp_ns


def test_of_a_batch_one_patch_is_read_by_its_name(publisher, reader):
    one = solved(1)
    found = contacts(1)
    of_both = dict.fromkeys(("error", "trusted", "unchanged", "reason"), ())
    of_both |= {
        name: 2 * getattr(one, name) for name in ("iterations", "residual", "solve_ns")
    }
    forces = np.concatenate([one.forces, 2 * one.forces])
    batch = {"names": ("a", "b")}
    touched = replace(
        found, **batch, trusted=(), patch_of=np.ones(1, np.int32), events=None
    )
    both = replace(one, **batch, forces=forces, **of_both), touched
    other = LatestFrames(None, "skin/b", with_contacts=True)

    def came():
        publisher.serve_subscriptions()
        send(publisher, 1, skin_state(), *both)
        return other.newest() is not None

    wait_until(came, "a frame")
    latest = other.newest()
    assert latest.frame.forces.tolist() == forces[1:].tolist()
    assert latest.contacts.patch == "b"
    assert latest.contacts.id.tolist() == [1]
    other.close()
    with pytest.raises(
        GraphError, match="/skin/reconstruction: patch: skin/a is one of 2"
    ):
        reader.newest(after=10**9, timeout_s=60)


def test_a_graph_without_contacts_is_one_line(publisher):
    nodes = {"host": RunningNode("reconstructor", publisher.endpoint, TOPICS[:2])}
    with (
        announced(RunningGraph("silent", 2, 0, "", nodes)),
        pytest.raises(
            GraphError, match=r"no /skin/contacts; start it with reconstructor.co"
        ),
    ):
        LatestFrames("silent", "skin", with_contacts=True)
