"""Budgets: times of the stages against numbers worked by hand, limits and words."""

import math
from dataclasses import replace

import numpy as np
import pytest
from measured_costs import SIZES, measure

from sparseskin.plugins.design import text
from sparseskin.plugins.design.budget import NO_GRID, STAGES, Accuracy, budget, frame_bytes, row_of
from sparseskin.plugins.design.models import FIGURES, HOP_S, LARGEST, cost, stored
from sparseskin.plugins.design.simulation import grid_of
from sparseskin.plugins.design.spec import make_design
from sparseskin.plugins.design.strategies import STRATEGIES

PALM = {"rows": 64, "cols": 64}


def row(name, **keys):
    return row_of(STRATEGIES[name], make_design({**PALM, **keys}))


def test_a_full_raster_of_a_palm_is_limited_by_its_line():
    found = row("all taxels")
    # 4096 readings of 10 bits and 15 bytes; 4096 conversions at 200 kS/s; 10 bits a byte at 2 Mbaud
    assert found.n_bytes == 5120 + 15
    assert found.stage_s["ADC"] == pytest.approx(4096 / 200e3)
    assert found.stage_s["bus"] == pytest.approx(51350 / 2e6)
    assert found.limit == "bus"
    # A line a row and column.
    assert (found.lines, found.conversions) == (128, 4096)
    assert found.possible_hz == pytest.approx(2e6 / 51350)
    assert not found.is_met


def test_the_budget_that_taxelscan_publishes_of_eight_boards_on_one_bus_is_found():
    """Its 60 Hz, 80 % of the bus, 1.05 MB/s and 11.2 ms of scan within 10 %: requests, headers and
    dark sweeps are not modelled. Source: `rigs.toml`.
    """
    keys = {"taxels": 8192, "converters": 8, "adc": "16bit@140.25kS/s", "settling": "3us"}
    found = row_of(
        STRATEGIES["all taxels"], make_design({**keys, "bus": "serial:12.5M", "rate": "60"})
    )
    assert found.is_met
    assert 60 * found.stage_s["bus"] == pytest.approx(0.80, rel=0.1)
    assert 60 * found.n_bytes == pytest.approx(1.05e6, rel=0.1)
    assert found.stage_s["ADC"] == pytest.approx(11.2e-3, rel=0.1)


def test_digital_sums_need_every_conversion_and_analog_ones_m():
    digital, analog = (row("N/4 sums"), row("N/4 sums", sums="analog", rows=16, cols=16))
    assert (digital.m, digital.conversions) == (1024, 4096)
    assert (analog.m, analog.conversions, analog.lines) == (64, 64, 256)
    # 24 * 4096 + 72 * 1024 + 16 * 1039 + 550 instructions of 2 cycles
    assert digital.stage_s["edge"] == pytest.approx(2 * 189_206 / 168e6)


def test_single_taxels_are_sent_with_the_bits_of_the_converter():
    d = make_design(PALM)
    sizes = {name: frame_bytes(STRATEGIES[name], d) - 15 for name in STRATEGIES}
    assert (sizes["all taxels"], sizes["N/4 taxels in turn"]) == (4096 * 10 // 8, 1024 * 10 // 8)
    assert (sizes["N/3 sums"], sizes["N/4 sums of rows"]) == (1366, 1024)
    assert sizes["N/4 adaptive sums"] == 1024 + math.ceil(2 * math.ceil(4096 / 3) / 8)


def test_the_slowest_stage_limits_the_rate_and_the_latency_is_their_sum():
    for found in budget(make_design({"rows": 12, "cols": 32, "bus": "spi:20M"})):
        assert found.possible_hz == min(found.stage_hz.values())
        assert found.stage_hz[found.limit] == found.possible_hz
        assert found.reached_hz == min(1000.0, found.possible_hz)
        assert found.latency_s == pytest.approx(sum(found.stage_s.values()) + HOP_S)
        assert found.host_cores == pytest.approx(found.reached_hz * found.stage_s["host"])
        assert set(found.stage_hz) == set(STAGES)


def test_a_skin_of_several_patches_uses_several_cores():
    one, four = row("N/4 sums", host="1cores"), row("N/4 sums", rows=128, cols=128)
    assert (one.patches, four.patches) == (1, 4)
    assert four.stage_s["host"] == pytest.approx(one.stage_s["host"])
    assert four.host_rate_hz == pytest.approx(one.host_rate_hz)
    alone = row("N/4 sums", rows=128, cols=128, host="1cores")
    assert alone.host_rate_hz == pytest.approx(one.host_rate_hz / 4)


def test_points_have_no_rows_and_no_neighbourhoods():
    rows = budget(make_design({"taxels": 4000}))
    assert [r.strategy.name for r in rows] == [n for n in STRATEGIES if n not in NO_GRID]
    # The smallest near square: 64 x 63 lines for 4000 points.
    assert rows[0].lines == 64 + 63
    # They are simulated on it, too.
    mask = grid_of(make_design({"taxels": 4000}))
    assert (mask.shape, np.count_nonzero(mask)) == ((63, 64), 4000)


def test_stored_costs_are_of_all_sizes_and_lie_between_their_neighbours():
    assert set(stored()["cost"]) == {str(rows * cols) for rows, cols in SIZES}
    for of in (of for costs in stored()["cost"].values() for of in costs.values()):
        assert of["edge_us"] > 0
        assert 0 < of["calm_us"] < 1.5 * of["dense_us"]
    for name in STRATEGIES:
        ends = sorted((cost(name, 1024).dense_s, cost(name, 4096).dense_s))
        assert ends[0] <= cost(name, 2000).dense_s <= ends[1]
        assert cost(name, 2 * LARGEST).dense_s == pytest.approx(2 * cost(name, LARGEST).dense_s)
        assert cost(name, 16).edge_s == pytest.approx(cost(name, 384).edge_s)


@pytest.mark.slow
def test_costs_are_measured_on_the_nodes_themselves():
    found = measure(STRATEGIES["N/4 sums"], (8, 8))
    assert set(found) == set(FIGURES)
    assert min(found.values()) > 0


def with_db(rows, **db):
    """Rows with a PSNR of 40 dB, or that stated by their names."""
    found = []
    for one in rows:
        mean = db.get(one.strategy.name, 40.0)
        found.append(replace(one, accuracy=Accuracy(mean, mean - 3, mean + 3, 0.02)))
    return found


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        # 512 readings of 10 bits: 655 bytes are 3.28 ms; 512 conversions 2.56 ms
        ({}, "bus: 655 bytes take 3.28 ms (UART at 2 Mbaud): 305 Hz"),
        ({"bus": "udp"}, "ADC: 512 conversions take 2.56 ms (10 bit at 200 kS/s): 391 Hz"),
        (
            {"bus": "udp", "edge": "cortex-m4@1MHz"},
            "edge: 23,318 instructions take 46.6 ms (Cortex-M4 at 1 MHz): 21 Hz",
        ),
    ],
)
def test_what_breaks_first_is_said_with_its_numbers(keys, line):
    design = make_design({"rows": 16, "cols": 32, **keys})
    assert text.breaks(row_of(STRATEGIES["all taxels"], design), design) == line


def test_a_design_that_all_taxels_hold_advises_to_read_them():
    keys = {"rows": 8, "cols": 8, "bus": "udp", "adc": "10bit@1MS/s", "rate": "20"}
    design = make_design(keys)
    rows = with_db(budget(design), **{"N/4 sums": 50.0})
    small = min(rows, key=lambda row: row.n_bytes)
    assert text.conclusions(rows, design) == [
        "Read all taxels: they reach 20 Hz, and nothing has to be reconstructed.",
        "The most accurate of those that reach it is N/4 sums (50.0 dB).",
        f"The fewest bytes a frame are {small.n_bytes}, of {small.strategy.name} (40.0 dB).",
    ]
    slow = make_design({**keys, "bus": "serial:115200", "rate": "150"})
    assert text.conclusions(budget(slow), slow)[0].startswith("All taxels reach 121 Hz alone; ")
