"""A graph under load by others: nothing is lost, nothing ends, nothing is left behind.

At full size 10,000 half-open connections, 1,000 pages three times, and commands for an hour.
"""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from conftest import wait_until
from stress import commands, half_open, open_pages
from stress.graphs import GraphRun, launch_text

from sparseskin.nodes.monitor.live.server import MAX_PAGES
from sparseskin.nodes.network.gate import MAX_PENDING

#: Open files of a node that is closing connections, beyond those that it may keep.
CLOSING = 64


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_what_is_removed_from_the_runtime_folder_is_noted() -> None:
    launch = launch_text({"sensor": {"source": "scene:path_40", "rate_hz": 5}, "compressor": {}})
    with GraphRun(launch) as graph:
        loop = commands._Loop(graph, 0.0)
        loop._check_files("before")
        assert loop.faults == []
        (graph.notes / "settings.json").unlink()
        (graph.notes / f"{graph.process.pid}.sock").unlink()
        loop._check_files("after")
        (line,) = loop.faults
        gone = f"{graph.process.pid}.sock, settings.json"
        assert line == f"after: removed from the runtime folder: {gone}"


@pytest.mark.parametrize(
    ("how", "code", "text", "is_fault"),
    [
        ("by itself", 0, "", False),
        ("by itself", 130, "", True),
        ("Ctrl-C", 130, "", False),
        ("Ctrl-C", 1, "", True),
        ("Ctrl-C", 1, 'Traceback\n  File "<frozen site>", line 9, in <module>\n', False),
        ("Ctrl-C", 1, 'Traceback\n  File "x/entry.py", line 18, in main\n', True),
        ("by itself", 1, 'Traceback\n  File "<frozen site>", line 9, in <module>\n', True),
        ("stop", 0, "Traceback", True),
        ("kill -9 of all", -9, "", False),
        ("kill -9 of all", 1, "", True),
    ],
)
def test_the_end_of_a_short_graph_is_judged(
    how: str, code: int, text: str, is_fault: bool, tmp_path: Path
) -> None:
    loop = commands._Loop.__new__(commands._Loop)
    loop.faults = []
    loop._judge("0-1", how, code, text, tmp_path / "none.json")
    assert bool(loop.faults) == is_fault


@pytest.mark.parametrize(
    ("frames", "is_fault"),
    [
        ({"lost": 0, "reconstructed": commands.SHORT_FRAMES}, False),
        ({"lost": 0, "reconstructed": commands.SHORT_FRAMES - 1}, True),
        ({"lost": 1, "reconstructed": commands.SHORT_FRAMES}, True),
    ],
)
def test_frames_that_a_short_graph_has_lost_are_a_fault(
    frames: dict[str, int], is_fault: bool, tmp_path: Path
) -> None:
    summary = tmp_path / "summary.json"
    summary.write_text(json.dumps({"patches": {"skin": {"frames": frames}}}))
    loop = commands._Loop.__new__(commands._Loop)
    loop.faults = []
    loop._judge("0-1", "by itself", 0, "", summary)
    assert bool(loop.faults) == is_fault


def test_pages_are_counted_by_their_answers() -> None:
    answers = (b"HTTP/1.1 200 OK\r\n\r\nab", b"HTTP/1.1 503 Full\r\n\r\n", b"")
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"http://127.0.0.1:{server.getsockname()[1]}/?token=t"
        with open_pages.Pages(url, 4, reading=1) as pages:
            accepted = [server.accept()[0] for _ in range(4)]
            for connection, answer in zip(accepted, answers, strict=False):
                request = connection.recv(1000).decode()
                assert "/stream?patch=skin&token=t" in request
                assert f"Host: {urlsplit(url).netloc}" in request
                connection.sendall(answer)
                connection.close()
            expected = {"200": 1, "503": 1, "closed": 1, "": 1}
            wait_until(lambda: pages.statuses() == expected, "the answers")
            accepted[3].close()
