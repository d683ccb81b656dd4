"""Study scale: figures of the nodes, what they add up to, and the search for the rate held."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("pandas", reason="the extra charts is not installed")

from sparseskin.studies.scale import live, offline
from sparseskin.studies.scale.missed import Missed, missed_lines
from sparseskin.studies.scale.nodes import time_batch
from sparseskin.studies.scale.study import exponent, needed, points_of


def test_exponent_of_a_power_law() -> None:
    taxels = [4096.0, 16384.0, 999424.0]
    assert exponent(taxels, [3e-7 * n**1.05 for n in taxels]) == pytest.approx(1.05)


def test_cores_and_links_for_a_million_taxels() -> None:
    row = {"patches": 2, "edge_us": 10.0, "host_us": 100.0, "bytes": 2 * 5000.0}
    found = needed(row)
    assert found["edge_cores"] == pytest.approx(2.44)
    assert found["host_cores"] == pytest.approx(24.4)
    assert found["gigabyte_s"] == pytest.approx(1.22)
    assert found["links"] == pytest.approx(9.76)
    assert found["full_links"] == pytest.approx(3 * 9.76)


def test_points_are_all_solved_first_and_then_mostly_idle() -> None:
    points = points_of(quick=True, seed=3)
    assert [(p["patches"], p["idle"], p["skip_idle"]) for p in points] == [
        *((1, 0.0, False), (4, 0.0, False), (1, 0.9, True), (4, 0.9, True)),
    ]


def test_a_batch_is_timed_with_its_bytes_and_idle_patches() -> None:
    common = {"patches": 3, "side": 8, "n_frames": 6, "seed": 0}
    solved = time_batch({**common, "idle": 0.0, "skip_idle": False})
    idle = time_batch({**common, "idle": 1.0, "skip_idle": True})
    assert solved["unchanged"] == 0.0
    assert idle["unchanged"] == pytest.approx(1.0, abs=0.2)
    assert min(solved["edge_us"], solved["host_us"]) > 0
    assert solved["bytes"] >= 3 * 4 * 22  # 22 of 64 taxels, float32


def test_rates_are_lowered_until_no_frame_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    def run_at(rate_hz: float, patches: int, active: float, seconds: float) -> dict[str, Any]:
        held = min(rate_hz, 30.0)
        skipped = round((rate_hz - held) * seconds)
        return {"rate_hz": rate_hz, "held_hz": held, "skipped": skipped, "lost": 0, "s": seconds}

    monkeypatch.setattr(live, "run_at", run_at)
    trials = live.rate_held(100.0, 16, 0.25, 10.0, 60.0)
    assert [(t["rate_hz"], t["s"]) for t in trials] == [(100, 10), (22.5, 10), (22.5, 60)]
    assert len(live.rate_held(20.0, 16, 0.25, 10.0)) == 1


def test_the_table_of_missed_contacts() -> None:
    lines = missed_lines([Missed(8, 1.0, (0.9, 0.5, 0.0, 0.0))], {"untouched": 0.0012})
    assert lines[1].split() == ["8", "x", "8", "1", "sigma", "90.0%", "50.0%", "0.0%", "0.0%"]
    assert lines[-1] == "frames solved though nothing changed: untouched 0.12 %"


def test_recorded_frames_are_counted_in_frames_and_bytes_of_their_taxels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(offline, "WAYS", {"one core": "serial", "two threads": "thread:2"})
    found = offline.throughput([2], [3], 8, 0)
    assert [one["way"] for one in found] == ["one core", "two threads"]
    for one in found:
        assert one["taxels"] == 2 * 64
        assert one["bytes_s"] == pytest.approx(4 * 128 * one["frames_s"])
    lines = offline.throughput_table(found).splitlines()
    assert "two threads" in lines[0]
    assert lines[2].startswith("| 128 |")
