"""A graph under load by others: nothing is lost, nothing ends, nothing is left behind.

At full size 10,000 half-open connections, 1,000 pages three times, and commands for an hour.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from stress import commands, half_open, open_pages

from sparseskin.nodes.monitor.live.server import MAX_PAGES
from sparseskin.nodes.network.gate import MAX_PENDING

#: Open files of a node that is closing connections, beyond those that it may keep.
CLOSING = 64


@pytest.mark.parametrize("files", [None, 64])
def test_half_open_connections_cost_a_graph_with_keys_nothing(
    files: int | None, full: bool, note: Any, tmp_path: Path
) -> None:
    n, n_wave, rate_hz = (10_000, 10_000, 50.0) if full else (900, 500, 20.0)
    point = {"n": n, "n_wave": n_wave, "files": files, "rate_hz": rate_hz}
    found = half_open.measure(point, tmp_path / "graph")
    note(attack=f"half-open connections, {files or 'all'} files", **found)
    assert (found["lost"], found["counted"], found["stopped"], found["left"]) == (0, 0, [], [])
    assert found["frames"] > 0
    for before, most, after in found["files"].values():
        assert after == before
        assert most <= (files or before + MAX_PENDING + CLOSING)
    assert max(most for _, most, _ in found["files"].values()) > 50
    assert found["closed"] >= n - found["waves"] * 3 * MAX_PENDING
    if not full:
        assert found["waves"] == len(found["joined_s"]) == 2
        assert found["lines"] < 3 * 300


def test_open_pages_cost_a_graph_nothing_and_are_refused_in_order(
    full: bool, note: Any, tmp_path: Path
) -> None:
    point = {"n": 300, "reading": 30, "seconds": 0.5, "times": 2, "rate_hz": 20.0}
    if full:
        point = {"n": 1000, "reading": 60, "seconds": 3.0, "times": 3, "rate_hz": 50.0}
    found = open_pages.measure(point, tmp_path / "graph")
    note(attack="open pages", **found)
    served = {"200": MAX_PAGES, "503": point["n"] - MAX_PAGES}
    assert found["statuses"] == [served] * point["times"]
    assert (found["lost"], found["counted"], found["stopped"], found["left"]) == (0, 0, [], [])
    assert found["frames"] > 0
    assert found["read_mb"] > 0
    for before, most, after in (found["files"], found["threads"]):
        assert before < most
        assert after == before


def test_commands_beside_graphs_that_start_and_end_remove_nothing_that_is_used(
    full: bool, note: Any
) -> None:
    found = commands.measure({"seconds": 3600.0 if full else 5.0, "seed": 1})
    note(attack="commands in a loop", **found)
    assert found["faults"] == []
    assert found["left"] == []
    assert found["frames"]["lost"] == 0
    assert found["frames"]["sensed"] > 0
    assert found["lists"] > 0
    assert sum(found["graphs"].values()) >= commands.N_STARTERS
