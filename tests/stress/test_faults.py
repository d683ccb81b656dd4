"""Faults in a running graph, each really caused: killed, crashed and stopped nodes, and others.

At full size each signal is sent to each node 3 times, in 7 graphs (25 minutes).
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from stress import cases, signals

Note = Callable[..., None]


@pytest.mark.parametrize(
    ("name", "transport"),
    [("SIGKILL", None), ("SIGKILL", "tcp"), ("SIGSEGV", None), ("SIGSTOP", None)],
)
def test_a_node_that_is_killed_crashes_or_stops_takes_no_other_with_it(
    name: str, transport: str | None, full: bool, note: Note, tmp_path: Path
) -> None:
    point = {"signal": name, "transport": transport}
    point |= {"repeats": 3, "stop_s": 5.0} if full else {"repeats": 1, "stop_s": 1.0}
    point["rate_hz"] = 100.0 if full else 20.0
    runs = [signals.measure(point, tmp_path / str(k)) for k in range(7 if full else 1)]
    dies = name != "SIGSTOP"
    for node in signals.NODES:
        struck = [one for run in runs for one in run["struck"][node]]
        assert not any(one["stopped"] for one in struck), node
        lost = statistics.median(one["lost"] for one in struck)
        # Monitor and recorder cost the stream nothing.
        assert bool(lost) == (dies and node in ("compressor", "reconstructor")), node
        times_s = [one["recover_s"] for one in struck]
        least, median, most = min(times_s), statistics.median(times_s), max(times_s)
        note(
            fault=f"{name} of the {node}",
            transport=transport or "default",
            lost=lost,
            not_acquired=statistics.median(one["not_sensed"] for one in struck),
            recovered_s=f"{median:.2f} ({least:.2f}..{most:.2f})",
        )
    assert not any(run["left"] for run in runs)
    assert all(bool(run["not_recorded"]) == dies for run in runs)
    recordings = sorted(path.name for path in (tmp_path / "0").glob("run*"))
    if not full:
        assert recordings == (["run.mcap.part", "run.restart1.mcap"] if dies else ["run.mcap"])


@pytest.fixture
def caused(full: bool, note: Note, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Causes a fault by its name, and returns its outcome; the test is skipped where it cannot."""

    def cause(fault: str, **small: Any) -> dict[str, Any]:
        point = {"seconds": 0.5, "delays_s": (0, 0.05), **small}
        if full:
            point = {"seconds": 3.0 if fault == "rate" else 10.0, "delays_s": (0.25, 2)}
        case = cases.CASES[fault]
        try:
            found = case.make(point, tmp_path / "graph")
        except cases.NotPermittedError as error:
            pytest.skip(str(error))
        note(fault=case.title, **found)
        assert (found["stopped"], found["left"]) == ([], [])
        return found

    return cause


def test_nothing_outlives_a_launcher_that_is_killed(caused: Any) -> None:
    assert not caused("launcher")["finding"].startswith("0 messages")


def test_a_node_that_is_killed_twenty_times_in_a_row_comes_back(caused: Any) -> None:
    assert caused("in a row")["finding"].startswith("20 restarts")


def test_by_default_a_node_that_is_killed_again_and_again_is_given_up(caused: Any) -> None:
    finding = caused("given up")["finding"]
    assert finding.startswith("exit code 1: ")
    assert finding.endswith("(5 restarts within 60 s: given up)")


def test_a_full_disk_costs_the_stream_no_frame(caused: Any) -> None:
    found = caused("full disk")
    assert found["lost"] == 0
    assert found["of"] > 0
    assert "No space left on device; recording ended" in found["finding"]


def test_ten_times_the_rate_loses_what_is_counted_and_then_it_is_as_before(caused: Any) -> None:
    found = caused("rate", rate_hz=20.0)  # slow enough for the solver on a busy host
    assert found["of"] > 0
    assert f"the graph itself counts {found['lost']};" in found["finding"]


def test_a_clock_that_steps_back_is_not_noticed(caused: Any) -> None:
    found = caused("clock")
    assert found["lost"] == 0
    assert found["finding"] == "in all 6 processes; 0 stamps of frames went back"


def test_a_driver_whose_stamps_step_back_is_named_and_ends_the_graph(caused: Any) -> None:
    finding = caused("driver")["finding"]
    assert finding.startswith("exit code 2; ")
    assert "stepping:frames, frame 101: stamp_ns" in finding


def test_subscribers_that_never_read_cost_the_stream_no_frame(caused: Any) -> None:
    assert caused("subscribers")["lost"] == 0


def test_refused_readers_are_named_get_nothing_and_disturb_nobody(caused: Any) -> None:
    found = caused("keys")
    assert found["lost"] == 0
    assert found["of"] > 0
    assert found["finding"].startswith("0 messages came to them; named after: an unlisted key ")
