"""Faults in a running graph, each really caused: the study `faults` in small."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sparseskin.studies.faults import cases as faults_cases
from sparseskin.studies.faults import signals as faults_signals
from sparseskin.studies.faults import study as faults

SMALL = {"seconds": 0.5, "delays_s": (0, 0.05)}


def made(fault: str, tmp_path: Path, **more: Any) -> dict[str, Any]:
    """The row of a fault; the test is skipped where it cannot be made."""
    try:
        return faults_cases.CASES[fault].make({**SMALL, **more}, tmp_path / "graph")
    except faults_cases.NotPermittedError as error:
        pytest.skip(str(error))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "transport"), [*((name, "ipc") for name in faults.SIGNALS), ("SIGKILL", "tcp")]
)
def test_a_node_that_is_killed_crashes_or_stops_takes_no_other_with_it(
    name: str, transport: str, tmp_path: Path
) -> None:
    point = {"signal": name, "repeats": 1, "stop_s": 1.0, "rate_hz": 20.0, "transport": transport}
    measured = faults_signals.measure(point, tmp_path / "graph")
    rows = {row["node"]: row for row in faults_signals.rows_of(name, [measured])}
    assert list(rows) == list(faults_signals.NODES)
    for node, row in rows.items():
        assert row["stopped"] == [], node
        assert row["left"] == [], node
        assert len(row["recover_s"]) == 1, node
    # Monitor and recorder cost the stream nothing.
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


@pytest.mark.slow
def test_a_node_that_is_killed_twenty_times_in_a_row_comes_back(tmp_path: Path) -> None:
    row = made("in a row", tmp_path)
    assert (row["stopped"], row["left"]) == ([], [])
    assert row["told"].startswith("20 restarts")


@pytest.mark.slow
def test_by_default_a_node_that_is_killed_again_and_again_is_given_up(tmp_path: Path) -> None:
    row = made("given up", tmp_path)
    assert row["left"] == []
    assert row["told"].startswith("exit code 1: ")
    assert row["told"].endswith("(5 restarts within 60 s: given up)")


@pytest.mark.slow
def test_a_full_disk_costs_the_stream_no_frame(tmp_path: Path) -> None:
    row = made("full disk", tmp_path)
    assert (row["lost"], row["stopped"], row["left"]) == (0, [], [])
    assert row["of"] > 0
    assert "No space left on device; recording ended, what it holds can be read" in row["told"]


@pytest.mark.slow
def test_ten_times_the_rate_loses_what_is_counted_and_then_it_is_as_before(tmp_path: Path) -> None:
    row = made("rate", tmp_path, rate_hz=20.0)  # slow enough for the solver on a busy host
    assert (row["stopped"], row["left"]) == ([], [])
    assert row["of"] > 0
    assert f"the graph itself counts {row['lost']};" in row["told"]


@pytest.mark.slow
def test_a_clock_that_steps_back_is_not_noticed(tmp_path: Path) -> None:
    row = made("clock", tmp_path)
    assert (row["lost"], row["stopped"], row["left"]) == (0, [], [])
    assert row["told"] == "in all 6 processes; 0 stamps of frames went back"


def test_a_driver_whose_stamps_step_back_is_named_and_ends_the_graph(tmp_path: Path) -> None:
    row = made("driver", tmp_path)
    assert row["left"] == []
    assert row["told"].startswith("exit code 2; ")
    assert "stepping:frames, frame 101: stamp_ns" in row["told"]


@pytest.mark.slow
def test_subscribers_that_never_read_cost_the_stream_no_frame(tmp_path: Path) -> None:
    row = made("subscribers", tmp_path)
    assert (row["lost"], row["stopped"], row["left"]) == (0, [], [])


@pytest.mark.slow
def test_refused_readers_are_named_get_nothing_and_disturb_nobody(tmp_path: Path) -> None:
    row = made("keys", tmp_path)
    assert (row["lost"], row["stopped"], row["left"]) == (0, [], [])
    assert row["of"] > 0
    assert row["told"].startswith("0 messages came to them; named after: an unlisted key ")


def lot(*recover_s: float, took_s: float = 100.0) -> dict[str, Any]:
    struck = {"lost": 0, "not_sensed": 0, "stopped": []}
    of_node = [{**struck, "recover_s": seconds} for seconds in recover_s]
    nodes = dict.fromkeys(faults_signals.NODES, of_node)
    return {"struck": nodes, "not_recorded": 0, "left": [], "took_s": took_s}


@pytest.mark.parametrize(
    ("took_s", "quick", "n_lots"), [(40.0, False, 7), (900.0, True, 1), (250.0, False, 2)]
)
def test_signals_are_sent_in_lots_until_the_time_is_used(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, took_s: float, quick: bool, n_lots: int
) -> None:
    made: list[int] = []

    def compute(function: Any, points: list[dict[str, Any]], *_: Any) -> list[dict[str, Any]]:
        made.append(len(points))
        return [lot(1.0, 2.0, 3.0, took_s=took_s) for _ in points]

    monkeypatch.setattr(faults, "compute", compute)
    rows = faults.strike(tmp_path, quick)
    assert made == [3] * n_lots
    assert len(rows) == len(faults.SIGNALS) * len(faults_signals.NODES)
    assert {len(row["recover_s"]) for row in rows} == {3 * n_lots}


def test_the_table_has_a_line_for_every_fault() -> None:
    assert [point["fault"] for point in faults.case_points(quick=True)] == list(faults_cases.CASES)
    row = {"fault": "clock", "recover_s": [0.2, 0.1, 0.4], "lost": 3, "of": 9}
    row |= {"stopped": [], "left": ["file x.part"], "told": "so it is"}
    assert list(faults.cells(row).values()) == [
        *("the wall clock steps back by 1 h", "3 of 9", "0.20 s (0.10..0.40)"),
        *("nothing", "file x.part", "so it is"),
    ]
    lost = [faults.cells({**row, "lost": n, "of": 0})["lost frames"] for n in (3.0, 7.5, "?")]
    assert lost == ["3", "7.5", "?"]
