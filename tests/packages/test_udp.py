"""A bridge of another package, installed as pip installs it."""

import json
import socket

import pytest
from bags import frame, skin_state
from installed import installed

from sparseskin.messages import Reconstruction
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.node import Context
from sparseskin.nodes.registry import node_class

pytest.importorskip(
    "sparseskin.plugins.bridges", reason="the core alone has no bridges"
)


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(60)
        yield receiver


@pytest.fixture
def bridge(tmp_path, monkeypatch, receiver):
    with installed("sparseskin_udp", tmp_path, monkeypatch):
        cls = node_class("udp")
        settings = cls.Settings(
            port=receiver.getsockname()[1], maps=("reconstruction",)
        )
        made = cls(settings, Context("udp", ManualClock()))
        yield made
        made.close({})


def test_a_datagram_has_the_largest_force_and_where_it_is(bridge, receiver):
    reconstruction = frame(3)[-1]
    assert isinstance(reconstruction, Reconstruction)
    list(bridge.step(skin_state()))
    list(bridge.step(reconstruction))
    sent = json.loads(receiver.recv(2048))
    (forces,) = reconstruction.forces
    assert sent["force"] == pytest.approx(float(forces.max()))
    assert forces[sent["row"], sent["col"]] == forces.max()
    assert sent["stamp_ns"] == reconstruction.stamp_ns
    assert sent["patch"] == "skin"
    assert sent["unit"] == "N"
    assert sent["reason"] == ""


def test_frames_before_their_skin_are_dropped_and_counted(bridge):
    list(bridge.step(frame(0)[-1]))
    assert bridge.n_sent == 0
    assert bridge.n_dropped == 1
    assert bridge.where() in bridge.status()


def test_it_reads_the_maps_that_it_is_asked_for(bridge):
    cls = type(bridge)
    assert cls.inputs(bridge.settings) == ("/skin/skin",)
    assert cls.optional_inputs(bridge.settings) == ("/skin/reconstruction",)
