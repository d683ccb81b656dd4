"""Warnings about settings of the compressor that are valid but reconstruct badly."""

import pytest

from sparseskin.nodes.bus import Bus
from sparseskin.nodes.compressor.node import Compressor, compression_warnings
from sparseskin.nodes.sensor.node import Sensor


@pytest.mark.parametrize(
    ("kind", "m", "block", "bits", "message"),
    [
        ("sbhe", 533, 32, 5, ""),
        ("sbhe", 100, 8, None, ""),
        ("full", 1600, 32, None, ""),
        ("gaussian", 200, 1, None, ""),
        ("sbhe", 99, 32, None, "m = 99 of n = 1600 taxels: more than one small contact is not"),
        ("sbhe", 533, 4, None, "block = 4: most measurements see no pressed taxel"),
        ("subsample", 400, 32, None, "phi = subsample: a contact of fewer than 4 taxels may touch"),
        ("sbhe", 533, 32, 4, "bits = 4: the steps of the quantiser lose"),
    ],
)
def test_settings_that_reconstruct_badly_are_warned_of_in_a_line(kind, m, block, bits, message):
    warnings = compression_warnings(kind, 1600, m, block, bits)
    assert len(warnings) == bool(message)
    for warning in warnings:
        assert warning.startswith(message)
        assert "advised: " in warning
        assert "\n" not in warning


def running(**compressor):
    bus = Bus(
        {
            "sensor": (Sensor, Sensor.Settings(source="scene:path_40")),
            "compressor": (Compressor, Compressor.Settings(**compressor)),
        }
    )
    bus.run(n_frames=2)
    return bus


def test_a_compressor_logs_a_warning_once_when_the_skin_is_known():
    (line,) = running(ratio=40).lines
    assert line.startswith("[compressor] m = 40 of n = 1600 taxels")


def test_a_compressor_logs_a_warning_when_few_bits_are_set_while_it_runs():
    bus = running()
    assert bus.lines == []
    compressor = bus.hosts["compressor"].node
    list(compressor.change(compressor.settings.changed({"bits": 4})))
    (line,) = bus.lines
    assert line.startswith("[compressor] bits = 4: ")
