"""Closed forms of buses, converters, edges and units, against numbers worked by hand; and what they
predict for rigs that were built.
"""

import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from sparseskin.nodes.errors import SettingsError
from sparseskin.plugins.design.models import (
    FORCE,
    LENGTH,
    RATE,
    TIME,
    Adc,
    Bus,
    Edge,
    instructions,
    quantity,
    read_adc,
    read_bus,
    read_edge,
)
from sparseskin.plugins.edge.description import EdgeDescription

RIGS = Path(__file__).parent / "rigs.toml"


def a_length(text):
    return quantity(text, LENGTH, "4mm", 0.0, 1.0)


def test_a_byte_has_ten_bits_on_a_serial_line_and_eight_clocks_of_spi():
    assert read_bus("serial:2M").seconds(514) == pytest.approx(5140 / 2e6)
    assert read_bus("spi:20M").seconds(1038) == pytest.approx(8304 / 20e6)


def test_a_full_frame_of_classic_can_has_135_bits():
    # 34 + 64 bits, floor(97 / 4) = 24 stuff bits, 13 bits of the end.
    assert read_bus("can:1M").seconds(8) == pytest.approx((98 + 24 + 13) * 1e-6)
    # Nine bytes are a full frame and one of a byte: 42 + floor(41 / 4) + 13 = 65 bits.
    assert read_bus("can:1M").seconds(9) == pytest.approx((135 + 65) * 1e-6)


def test_a_full_frame_of_can_fd_has_34_slow_and_678_fast_bits():
    bus = read_bus("can-fd")
    # 5 + 512 bits, floor(533 / 4) - 4 = 129 stuff bits, 32 of the CRC; slow: 17 + 4 + 13.
    assert bus.seconds(64) == pytest.approx(34e-6 + (5 + 512 + 129 + 32) / 5e6)
    # To 16 bytes the CRC has 27 bits: 5 + 128 + (149 // 4 - 4) + 27.
    assert bus.seconds(16) == pytest.approx(34e-6 + (5 + 128 + 33 + 27) / 5e6)
    # The last frame is filled to the next length.
    assert bus.seconds(64 + 33) == pytest.approx(bus.seconds(64) + bus.seconds(48))


def test_a_datagram_has_66_bytes_beside_its_data():
    # Of a byte the least Ethernet frame, with preamble and gap: 84.
    assert read_bus("udp").seconds(1472) == pytest.approx(1538 * 8 / 100e6)
    assert read_bus("udp:1G").seconds(1473) == pytest.approx((1538 + 84) * 8 / 1e9)


@pytest.mark.parametrize(
    ("read", "text", "fault"),
    [
        (read_bus, "seral:2M", "'seral:2M': bus is not known (did you mean 'serial'?)"),
        (read_bus, "serial:2Mbaud", "'2Mbaud': unit 'Mbaud' is not known"),
        (read_bus, "can-fd:5M/1M", "'can-fd:5M/1M': data are slower than the arbitration"),
        (read_adc, "10bit", "expected bits and samples a second, as 10bit@200kS/s"),
        (read_adc, "10bit@200k", "unit 'k' is not known; allowed: S/s, kS/s, MS/s"),
        (read_edge, "cortex-m5@1MHz", "did you mean 'cortex-m4'?"),
        *((a_length, text, "") for text in ("4", "-4mm", "nanmm", 4)),
    ],
)
def test_a_text_of_another_form_is_refused_in_one_line(read, text, fault):
    with pytest.raises(SettingsError) as error:
        read(text)
    assert fault in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (read_bus(" can-fd : 500 k / 2 M "), Bus("can-fd", (5e5, 2e6))),
        (read_adc("12 bit @ 77 kS/s"), Adc(12, 77e3)),
        (read_edge("cortex-m4 @ 168 MHz"), Edge(168e6)),
        (read_edge("linux"), Edge(None)),
        (quantity("10mN", FORCE, "x", 0.0, 1e6), 0.01),
        (quantity("1kHz", RATE, "x", 0.0, 1e6), quantity("1000", RATE, "x", 0.0, 1e6)),
    ],
)
def test_texts_are_read_with_spaces_and_units(found, expected):
    assert found == expected


def test_converters_share_the_conversions_and_each_waits_for_its_multiplexer():
    assert Adc(10, 200e3).seconds(4096) == pytest.approx(20.48e-3)
    # ceil(4096 / 3) = 1366 conversions of 5 + 2 us
    assert Adc(10, 200e3, 3, 2e-6).seconds(4096) == pytest.approx(1366 * 7e-6)


@pytest.mark.parametrize(
    ("n_rows", "n_cols", "ratio", "bits", "rows", "counted"),
    [
        (12, 32, 3, 8, "rotating", 21149),
        (32, 32, 16, 8, "rotating", 30296),
        (40, 40, 4, 16, "rotating", 78607),
        (64, 64, 3, 8, "fixed", 215698),
    ],
)
def test_instructions_are_within_5_percent_of_those_counted(
    n_rows, n_cols, ratio, bits, rows, counted
):
    """Counted by `make cortex-m4` of exported edges, the largest number."""
    d = EdgeDescription.chosen(n_rows, n_cols, ratio=ratio, bits=bits, rows=rows)
    assert instructions(d.n_taxels, d.m, d.frame_bytes) == pytest.approx(counted, rel=0.05)


def test_rigs_that_were_built_are_predicted():
    """Within a factor 2 of the published rate, but for two; what explains them is in the file."""
    ratios = {}
    for rig in tomllib.loads(RIGS.read_text(encoding="utf-8"))["rig"]:
        hz = []
        if "adc" in rig:
            settling_s = quantity(rig.get("settling", "0us"), TIME, "5us", 0.0, 1.0)
            adc = replace(read_adc(rig["adc"]), settling_s=settling_s)
            hz.append(1 / adc.seconds(rig["conversions"]))
        if "bus" in rig:
            hz.append(1 / read_bus(rig["bus"]).seconds(rig["n_bytes"]))
        ratios[rig["name"]] = min(hz) / rig["published_hz"]
    beyond = [name for name, ratio in ratios.items() if not 0.5 <= ratio <= 2]
    assert (len(ratios), beyond) == (9, ["3D-ViTac", "SPTS, 7 % of 100"])
    assert ratios["FlexiTac, bus alone"] == pytest.approx(1.0, abs=0.001)
