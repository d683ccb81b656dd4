"""What breaks in a graph that runs, each fault really made: the study `faults` in small."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from sparseskin.studies import faults, faults_cases, faults_signals

SMALL = {"seconds": 0.5, "delays_s": (0, 0.05)}


def made(fault: str, tmp_path: Path, **more: Any) -> dict[str, Any]:
    """What came of a fault; the test is skipped where it cannot be made."""
    try:
        return faults_cases.CASES[fault]({**SMALL, **more}, tmp_path / "graph")
    except faults_cases.NotPermittedError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("name", faults.SIGNALS)
def test_a_node_that_is_killed_crashes_or_stops_takes_no_other_with_it(
    name: str, tmp_path: Path
) -> None:
    point = {"signal": name, "repeats": 1, "stop_s": 1.0, "rate_hz": 50.0}
    measured = faults_signals.measure(point, tmp_path / "graph")
    rows = {row["node"]: row for row in faults_signals.rows_of(name, [measured])}
    assert list(rows) == list(faults_signals.NODES)
    for node, row in rows.items():
        assert row["stopped"] == [], node
        assert row["left"] == [], node
        assert len(row["recover_s"]) == 1, node
    # Who only watches or records costs the stream nothing.
    assert rows["monitor"]["lost"] == rows["recorder"]["lost"] == 0
    dies = name != "SIGSTOP"
    assert bool(rows["compressor"]["lost"]) == bool(rows["reconstructor"]["lost"]) == dies
    assert bool(rows["recorder"]["not_recorded"]) == dies
    recordings = sorted(path.name for path in (tmp_path / "graph").glob("run*"))
    assert recordings == (["run.mcap.part", "run.restart1.mcap"] if dies else ["run.mcap"])


def test_nothing_outlives_a_launcher_that_is_killed(tmp_path: Path) -> None:
    row = made("launcher", tmp_path)
    assert row["left"] == []
    assert not row["told"].startswith("0 messages")


def test_a_node_that_is_killed_twenty_times_in_a_row_comes_back(tmp_path: Path) -> None:
    row = made("in a row", tmp_path)
    assert (row["stopped"], row["left"]) == ([], [])
    assert row["told"].startswith("20 restarts")


def test_by_default_a_node_that_is_killed_again_and_again_is_given_up(tmp_path: Path) -> None:
    row = made("given up", tmp_path)
    assert row["left"] == []
    assert row["told"].startswith("exit code 1: ")
    assert row["told"].endswith("(5 restarts within 60 s: given up)")


def test_a_full_disk_costs_the_stream_no_frame(tmp_path: Path) -> None:
    row = made("full disk", tmp_path)
    assert (row["lost"], row["stopped"], row["left"]) == (0, [], [])
    assert row["of"] > 0
    assert "No space left on device; recording ended, what it holds can be read" in row["told"]


def test_ten_times_the_rate_loses_what_is_counted_and_then_it_is_as_before(tmp_path: Path) -> None:
    row = made("rate", tmp_path)
    assert (row["stopped"], row["left"]) == ([], [])
    assert row["of"] > 0
    assert f"the graph itself counts {row['lost']};" in row["told"]


def test_a_clock_that_steps_back_is_not_noticed(tmp_path: Path) -> None:
    row = made("clock", tmp_path)
    assert (row["lost"], row["stopped"], row["left"]) == (0, [], [])
    assert row["told"] == "in all 6 processes; 0 stamps of frames went back"


def test_a_driver_whose_stamps_step_back_is_named_and_ends_the_graph(tmp_path: Path) -> None:
    row = made("driver", tmp_path)
    assert row["left"] == []
    assert row["told"].startswith("exit code 2; ")
    assert "stepping:frames, frame 101: stamp_ns" in row["told"]


def test_subscribers_that_never_read_cost_the_stream_no_frame(tmp_path: Path) -> None:
    row = made("subscribers", tmp_path)
    assert (row["lost"], row["stopped"], row["left"]) == (0, [], [])


def test_who_is_not_let_in_is_named_gets_nothing_and_disturbs_nobody(tmp_path: Path) -> None:
    row = made("keys", tmp_path)
    assert (row["lost"], row["stopped"], row["left"]) == (0, [], [])
    assert row["of"] > 0
    assert row["told"].startswith("0 messages came to them; named after: an unlisted key ")


@pytest.mark.parametrize("n", range(5, 40))
def test_the_median_is_in_the_smallest_interval_of_values_that_holds_it_often_enough(
    n: int,
) -> None:
    """It is below the k-th of n values with the chance that less than k of them are below it."""
    low, high = faults_signals.median_interval([float(v) for v in reversed(range(n))])
    k = round(low) + 1
    assert high == n - k

    def missed(k: int) -> float:
        return 2 * sum(math.comb(n, j) for j in range(k)) / 2**n

    assert missed(k) <= 0.1 < missed(k + 1)


def test_of_few_values_all_are_needed() -> None:
    assert faults_signals.median_interval([3.0, 1.0, 2.0]) == (1.0, 3.0)


def lot(*recover_s: float, took_s: float = 100.0) -> dict[str, Any]:
    struck = {"lost": 0, "not_sensed": 0, "stopped": []}
    of_node = [{**struck, "recover_s": seconds} for seconds in recover_s]
    nodes = dict.fromkeys(faults_signals.NODES, of_node)
    return {"struck": nodes, "not_recorded": 0, "left": [], "took_s": took_s}


SURE, UNSURE = lot(1.0, 1.05, 1.1, 1.0, 1.1), lot(1.0, 2.0, 3.0, 1.0, 3.0)


@pytest.mark.parametrize(
    ("of_kill", "of_others", "quick", "lots"),
    [
        (SURE, SURE, False, [3]),
        (UNSURE, SURE, False, [3, 1, 1, 1]),
        (UNSURE, UNSURE, True, [3]),
        (lot(1.0, 3.0, took_s=500), SURE, False, [3, 1]),
        (lot(1.0, 3.0, took_s=1200), SURE, False, [3]),
    ],
)
def test_signals_are_sent_until_the_medians_are_known_or_the_time_is_used(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    of_kill: dict[str, Any],
    of_others: dict[str, Any],
    quick: bool,
    lots: list[int],
) -> None:
    made: list[int] = []

    def compute(function: Any, points: list[dict[str, Any]], *_: Any) -> list[dict[str, Any]]:
        made.append(len(points))
        return [of_kill if point["signal"] == "SIGKILL" else of_others for point in points]

    monkeypatch.setattr(faults, "compute", compute)
    rows = faults.strike(tmp_path, quick)
    assert made == lots
    assert len(rows) == len(faults.SIGNALS) * len(faults_signals.NODES)
    n_of_kill = len(lots) * len(of_kill["struck"]["sensor"])
    assert [len(row["recover_s"]) for row in rows if row["fault"] == "SIGKILL"] == [n_of_kill] * 5


def test_the_table_has_a_line_for_every_fault() -> None:
    assert [point["fault"] for point in faults.case_points(quick=True)] == list(faults.CASES)
    assert set(faults.CASES) == set(faults_cases.CASES)
    row = {"fault": "clock", "recover_s": [0.2, 0.1, 0.4], "lost": 3, "of": 9}
    row |= {"stopped": [], "left": ["file x.part"], "told": "so it is"}
    assert faults.cells(row) == [
        *("the wall clock steps back by 1 h", "3 of 9", "0.20 s (0.10..0.40)"),
        *("nothing", "file x.part", "so it is"),
    ]
    assert [faults.cells({**row, "lost": n, "of": 0})[1] for n in (3.0, 7.5, "?")] == [
        *("3", "7.5", "?"),
    ]
