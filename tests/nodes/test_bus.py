"""The graph in one process."""

from collections import Counter
from dataclasses import replace

import numpy as np
from damaged import refusal

from sparseskin.messages import End, Measurements, PhiState, Reconstruction, Taxels, Truth
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.errors import RefusedError
from sparseskin.nodes.monitor.node import Monitor
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.node import Sensor


def graph(scene="path_40", **reconstructor):
    return {
        "sensor": (Sensor, Sensor.Settings(source=f"scene:{scene}", seed=3)),
        "compressor": (Compressor, Compressor.Settings(seed=1)),
        "reconstructor": (
            Reconstructor,
            Reconstructor.Settings(**({"iterations": 5} | reconstructor)),
        ),
        "monitor": (Monitor, Monitor.Settings()),
    }


def test_a_frame_passes_all_stations_with_one_stamp():
    clock = ManualClock(1_000)
    bus = Bus(graph(), clock)
    for messages in bus.frames(3):
        assert Counter(type(m) for m in messages) == dict.fromkeys(
            (Taxels, Truth, Measurements, Reconstruction), 1
        )
        assert len({m.stamp_ns for m in messages}) == 1
        clock.advance(5)
    frames = bus.reports()["monitor"]["patches"]["skin"]["frames"]
    assert frames == {"sensed": 3, "reconstructed": 3, "skipped": 0, "lost": 0, "unpaired": 0}


def test_stamps_differ_even_on_a_clock_that_stands_still():
    stamps = [messages[0].stamp_ns for messages in Bus(graph(), ManualClock(7)).frames(4)]
    assert stamps == [7, 8, 9, 10]


def test_measurements_of_another_phi_are_refused_by_name():
    bus = Bus(graph())
    measured = [m for m in next(bus.frames(1)) if isinstance(m, Measurements)]
    other = replace(measured[0], phi="0" * 16)
    shown = refusal(lambda: list(bus.hosts["reconstructor"].node.step(other)), RefusedError)
    assert f"made by Phi {other.phi}, this reconstructor inverts Phi " in shown
    assert shown.endswith("and 2 other row subsets")


def test_an_announced_phi_is_proved_by_its_fingerprint():
    bus = Bus(graph())
    host = bus.hosts["reconstructor"]
    fields = {"run_id": "f" * 16, "kind": "sbhe", "n": 1600, "m": 533, "block": 32, "seed": 1}
    announced = PhiState(stamp_ns=0, patch="skin", fingerprint="0" * 16, **fields)
    assert list(host.receive(announced)) == []
    assert "its program differs" in bus.lines[-1]
    for change in ({"kind": "os:system"}, {"n": 1599}, {"m": 1601}, {"block": 7}):
        seq = host.counts.inputs["/skin/phi"].expected
        assert list(host.receive(replace(announced, seq=seq, **change))) == []
    assert (host.counts.refused, host.failure) == ({"refused": 5}, "")


def test_the_full_matrix_and_no_shrinkage_give_back_the_taxels():
    nodes = graph(preset="paper", lambda_n=0.0)
    nodes["compressor"] = (Compressor, Compressor.Settings(phi="full"))
    for messages in Bus(nodes).frames(3):
        by_type = {type(m): m for m in messages}
        np.testing.assert_allclose(
            by_type[Reconstruction].forces, by_type[Taxels].forces, atol=1e-5
        )


def test_a_source_runs_to_its_end_and_ends_every_stream():
    bus = Bus(graph("lift_box_40", preset="paper", iterations=1))
    kinds = Counter(type(m) for messages in bus.frames() for m in messages)
    assert kinds[Taxels] == kinds[Reconstruction] == 700
    assert kinds[End] == 4  # taxels, truth, measurements, reconstruction
    assert all(host.finished for host in bus.hosts.values())


def test_forces_of_a_shape_that_the_skin_does_not_have_are_refused():
    bus = Bus(graph())
    host = bus.hosts["compressor"]
    wrong = Taxels(stamp_ns=0, patch="skin", run_id="f" * 16, forces=np.ones((40, 39), np.float32))
    assert list(host.receive(wrong)) == []
    assert "forces of shape (40, 39), but the skin has (40, 40)" in bus.lines[-1]
