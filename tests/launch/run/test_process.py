"""What the launcher reads of a node: in bounded parts, so that a flood makes it deaf to nothing."""

import contextlib
import json
import os
import signal
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from conftest import PATIENCE_S, note_of_graph, wait_until
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.launch.attach.client import ask_node
from sparseskin.launch.launchfile.load import load
from sparseskin.launch.run.process import (
    CHUNK_BYTES,
    LOG_BYTES,
    MAX_LINE_BYTES,
    AwakeClock,
    LogLines,
    NodePipes,
    _added,
    exit_text,
    start_process,
)
from sparseskin.launch.run.running import GraphError, choose_graph
from sparseskin.nodes.errors import SparseskinError

FLOODING = """
import itertools, os, threading, time
import numpy as np
def flood():
    while True: os.write(2, b"flood" * 1000)
def frames():
    threading.Thread(target=flood, daemon=True).start()
    for k in itertools.count(): time.sleep(0.05); yield k, np.zeros((8, 8))
"""


def test_lines_are_put_together_from_chunks_within_bounds_and_those_that_were_cut_are_counted():
    log = LogLines()
    assert (log.take(b"one\ntw", 0.0), log.take(b"o\n\nthr", 0.1)) == (["one"], ["two"])
    assert log.take(b"", 0.2, at_end=True) == ["thr"]
    for _ in range(1000):
        log.take(b"x" * CHUNK_BYTES, 0.0)
        assert len(log._rest) <= MAX_LINE_BYTES
    log = LogLines()
    log.take(b"a\n" * 2000, 0.0)
    assert log.take(b"the end", 0.1, at_end=True)[1:] == ["the end"]
    log = LogLines()
    found = [line for _ in range(100) for line in log.take(b"abcde\n" * 1000, 5.0)]
    n_kept = LOG_BYTES // 105 + 1
    assert found == ["abcde"] * n_kept
    cut = f"{100_000 - n_kept} lines were cut (more than 100 kB a second)"
    assert (log.take(b"", 5.9), log.take(b"next\n", 6.0)) == ([], [cut, "next"])
    assert log.take(b"", 7.0) == []


WORDS = st.lists(st.text("ab", min_size=1, max_size=12), max_size=12)


@given(words=WORDS, cuts=st.lists(st.integers(0, 100), max_size=8))
def test_lines_are_the_same_whatever_pieces_they_come_in(words, cuts):
    text = "".join(f"{word}\n" for word in words).encode() + b"rest"
    places = sorted({0, *(cut for cut in cuts if cut < len(text)), len(text)})
    log = LogLines()
    lines = []
    for begin, end in pairwise(places):
        lines += log.take(text[begin:end], 0.0)
    assert lines == words
    assert log.take(b"", 0.0, at_end=True) == ["rest"]


@pytest.mark.parametrize(
    ("n_bytes", "is_broken"), [(MAX_LINE_BYTES, False), (MAX_LINE_BYTES + 1, True)]
)
def test_a_line_without_an_end_is_broken_once_it_is_too_long(n_bytes, is_broken):
    lines = LogLines().take(b"x" * n_bytes, 0.0)
    assert lines == (["x" * n_bytes] if is_broken else [])


@given(n_bytes=st.integers(1, 3000))
def test_a_node_may_log_100_kb_a_second_each_line_counting_100_bytes_more(n_bytes):
    log = LogLines()
    n_lines = 1000
    chunk = (b"x" * n_bytes + b"\n") * n_lines
    lines = log.take(chunk, 50.0)
    n_kept = min(n_lines, -(-100_000 // (n_bytes + 100)))
    assert len(lines) == n_kept
    later = log.take(b"next\n", 50.99)
    assert (later == ["next"]) == (n_kept * (n_bytes + 100) < 100_000)
    fresh = log.take(b"again\n", 51.0)
    n_cut = n_lines - n_kept + (not later)
    assert fresh[-1] == "again"
    assert [int(line.split()[0]) for line in fresh[:-1]] == [n_cut] * (n_cut > 0)


def test_a_node_that_logs_nothing_holds_up_nobody():
    pipes = NodePipes(load("path_40").nodes["sensor"])
    try:
        assert not os.get_blocking(pipes.log.fileno())
        assert pipes.log.read(CHUNK_BYTES) is None
    finally:
        pipes.close_of_node()
        pipes.channel.close()
        pipes.log.close()


@pytest.fixture
def started(tmp_path, monkeypatch):
    """Nodes of one process, which runs a shell script in place of Python, and its log."""
    nodes = []

    def start(script, *names):
        program = tmp_path / "program"
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o700)
        monkeypatch.setattr(sys, "executable", str(program))
        specs = load("path_40").nodes
        nodes.extend(start_process([(specs[name], {"name": name}) for name in names]))
        nodes[0].process.wait()
        _, lines = nodes[0].read()
        return nodes, lines

    yield start
    for node in nodes:
        node.close()


def test_a_node_has_a_session_of_its_own(started):
    """So that Ctrl-C in a terminal is a signal for its launcher alone."""
    (node,), (line,) = started("exec cat /proc/self/stat", "sensor")
    *_, session = line.rpartition(")")[2].split()[:4]
    assert int(session) == node.pid


def test_all_that_a_node_prints_is_its_log(started):
    _, lines = started("echo one; echo two >&2", "sensor")
    assert lines == ["one", "two"]


@pytest.mark.parametrize(("stated", "threads"), [(None, "1"), ("3", "3")])
def test_a_node_has_one_thread_where_the_environment_states_no_number(
    started, monkeypatch, stated, threads
):
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
        if stated:
            monkeypatch.setenv(name, stated)
    _, lines = started("echo $OMP_NUM_THREADS $OPENBLAS_NUM_THREADS", "sensor")
    assert lines == [f"{threads} {threads}"]


def test_a_process_has_the_channels_and_counters_of_all_its_nodes(started):
    names = ("sensor", "compressor")
    nodes, (stated, *descriptors) = started("head -n 1; ls /proc/self/fd", *names)
    config = json.loads(stated)
    assert config["name"] == "sensor"
    assert config["companions"] == ["compressor"]
    (of_compressor,) = config["channels"]
    passed = {*of_compressor, *(node._tally.fd for node in nodes)}
    assert passed <= set(map(int, descriptors))


def test_a_process_has_the_end_of_no_pipe_that_it_shall_see_end(started):
    """Where the launcher had the end of a node, too, it would not see its end."""
    (node,), _ = started("exit 3", "sensor")
    node.read()
    assert node.exit_code() == 3
    assert node.closed_pipes == set(node.pipes)


def test_a_process_that_cannot_be_started_names_its_nodes(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "none"))
    specs = load("path_40").nodes
    nodes = [(specs[name], {}) for name in ("sensor", "compressor")]
    with pytest.raises(SparseskinError, match=r"^sensor, compressor: "):
        start_process(nodes)


COUNTERS = st.dictionaries(st.sampled_from("abc"), st.integers(0, 99))


@given(
    first=st.dictionaries(st.sampled_from("xy"), COUNTERS),
    second=st.dictionaries(st.sampled_from("xy"), COUNTERS),
)
def test_counters_of_two_runs_are_added_by_their_keys(first, second):
    added = _added(first, second)
    assert added.keys() == first.keys() | second.keys()
    for key, counters in added.items():
        before = first.get(key, {})
        after = second.get(key, {})
        expected = {k: before.get(k, 0) + after.get(k, 0) for k in {*before, *after}}
        assert counters == expected


@pytest.mark.parametrize(
    ("code", "text"), [(0, "0"), (1, "1"), (-9, "SIGKILL"), (-15, "SIGTERM")]
)
def test_an_exit_code_is_named_by_its_number_or_signal(code, text):
    assert exit_text(code).split()[-1] == text


@given(st.lists(st.floats(0.0, 5.0), max_size=20))
def test_a_clock_goes_on_by_a_second_at_most_each_time_it_is_read(steps_s):
    now_s = 50.0
    clock = AwakeClock(lambda: now_s)
    before_s = clock()
    assert before_s == now_s
    for step_s in steps_s:
        now_s += step_s
        after_s = clock()
        assert after_s - before_s == pytest.approx(min(step_s, 1.0), abs=1e-9)
        before_s = after_s


def test_a_launcher_hears_signals_while_a_node_floods_its_log(start, sensor, tmp_path):
    (tmp_path / "flooding.py").write_text(FLOODING)
    program = start("launch", sensor, "--set", "sensor.source=flooding:frames")
    program.wait_for("[launch] ready")
    program.wait_for("lines were cut (more than 100 kB a second)")
    os.kill(program.process.pid, signal.SIGHUP)
    program.ended(128 + signal.SIGHUP)
    wait_until(lambda: not program.survivors(), "the end of all processes")


def test_the_clock_stands_still_while_the_launcher_does():
    now_s = [100.0]
    clock = AwakeClock(lambda: now_s[0])
    began_s = clock()
    for step_s, passed_s in ((0.5, 0.5), (14.0, 1.5), (1.0, 2.5)):
        now_s[0] += step_s
        assert clock() - began_s == pytest.approx(passed_s)


def test_live_recordings_leave_no_descriptor_open(start, sensor, tmp_path, monkeypatch):
    program = start("launch", sensor)
    program.wait_for("[launch] ready")
    pid = program.process.pid
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))
    monkeypatch.setattr("sparseskin.launch.attach.client.PATIENCE_S", PATIENCE_S)
    note_of_graph(tmp_path / "graphs")
    graph = choose_graph(None)

    def record(on):
        ask_node(graph, "launch", "record", on)

    def n_open():  # but sockets, of which an answer of the launcher leaves one for a while
        found = []
        for one in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):  # one that is closed meanwhile
                found.append(os.readlink(one))
        return sum("socket" not in target for target in found)

    n_before = n_open()
    for _ in range(2):
        record(True)
        record(False)
        wait_until(lambda: n_open() <= n_before, "the end of its pipes")
        for recording in tmp_path.glob("*.mcap"):  # two within a second have one name
            recording.unlink()
    record(True)
    os.kill(program.pid_of("live_recorder_3"), signal.SIGKILL)
    program.wait_for("[launch] live_recorder_3 ended too early")
    with pytest.raises(GraphError, match="record: not on"):
        ask_node(graph, "launch", "record", False)
    nested = []
    for _ in range(500):
        nested = [nested]
    with pytest.raises(GraphError, match="value: nested more than 4 deep"):
        ask_node(graph, "launch", "record", nested)
