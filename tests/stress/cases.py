"""Faults of the whole: launcher, disk, clock, rate, readers; each done to a graph of its own."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from stress.graphs import (
    RATE_HZ,
    GraphError,
    GraphRun,
    ObservedGraph,
    graph_text,
    outcome_of,
    wait_until,
)

from sparseskin.nodes.network.keys import KeyPair, make_key_files, read_key_pair
from sparseskin.nodes.network.sockets import Reader, make_context
from sparseskin.nodes.process.proc import cpu_s, own_bytes
from sparseskin.nodes.recorder.bag.reader import BagReader

N_STALLED = 100
N_KILLS = 20
STEP_NS = 3600 * 10**9
DISK = "1m"
GET_S = 1.0
"""Time for which a refused reader goes on waiting for a message."""
#: Found by Python before any module of its own: the wall clock of a process, an hour back once a
#: file exists. The monotonic clock, which no step of the wall clock moves, is left as it is.
_STEPPED = """
import os, time
open({loaded!r} + str(os.getpid()), "w").close()
_ns = time.time_ns
def _now(): return _ns() - {step_ns} * os.path.exists({switch!r})
time.time_ns = _now
time.time = lambda: _now() / 1e9
"""
#: A driver whose own stamps step back after a second.
_DRIVER = """
import time
import numpy as np

def frames():
    for k in range(10**9):
        time.sleep(0.01)
        yield time.monotonic_ns() - (k > 100) * {step_ns}, np.zeros((40, 40))
"""
#: Subscribers of all topics of an endpoint that never read: once they are connected, which goes on
#: in a thread of ZeroMQ's, the process stops itself, so that not even that thread reads.
_STALLED = """
import os, signal, sys, time
import zmq
from sparseskin.nodes.network.sockets import make_context

context = make_context()
context.set(zmq.MAX_SOCKETS, 4096)
sockets = [context.socket(zmq.SUB) for _ in range(int(sys.argv[1]))]
for stalled in sockets:
    stalled.setsockopt(zmq.RCVHWM, 1)
    stalled.subscribe(b"")
    stalled.connect(sys.argv[2])
time.sleep(1.0)
print("stalled", flush=True)
os.kill(os.getpid(), signal.SIGSTOP)
"""
_SECURITY = """
[security]
keys = "keys"
key = "edge"
"""
#: Readers that a secured graph refuses, and the words with which it logs each.
_REFUSED = {
    "an unlisted key": "its key is that of lab, and not on the list",
    "a wrong key of the host": "it has a wrong key for this host",
    "no key": "it uses no key",
}


class NotPermittedError(Exception):
    """A fault that cannot be made on this host; the text gives the reason."""


def launcher(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The launcher is killed: every node notices and ends, and the recording stays readable."""
    with ObservedGraph(graph_text(), "--record", "run.mcap", folder=folder) as graph:
        graph.probe.wait_for_frame(max_age_ns=math.inf)
        in_memory = graph.shared_memory()
        graph.process.kill()
        graph.process.wait()
        took_s = wait_until(lambda: not graph.processes(), "the end of all nodes")
        # A note that is not locked belongs to a graph that is gone; the next command removes it.
        n_notes = len(list(graph.notes.iterdir()))
        graph.start("monitor", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).wait()
        left = graph.left_behind() + in_memory
    finding = f"{_n_recorded(folder / 'run.mcap')} messages recorded; {n_notes} notes cleared away"
    return outcome_of(finding, left, took_s)


def in_a_row(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The reconstructor is killed `N_KILLS` times, each time as soon as its process runs."""
    first_s, longest_s = point["delays_s"]
    delays = {"restart_delay_s": first_s, "restart_max_delay_s": longest_s}
    launch = graph_text({"max_restarts": 100, "restart_window_s": None, **delays})
    with ObservedGraph(launch, folder=folder) as graph:
        launcher_s = cpu_s(graph.process.pid)
        _kill_again_and_again(graph)
        last_ns = graph.probe.now_ns()
        recover_s = graph.probe.wait_for_frame(last_ns, math.inf)
        took_s = (graph.probe.now_ns() - graph.began_ns) / 1e9
        finding = (
            f"{N_KILLS} restarts in {(last_ns - graph.began_ns) / 1e9:.0f} s, the launcher at "
            f"{100 * (cpu_s(graph.process.pid) - launcher_s) / took_s:.0f} % of a core"
        )
        return graph.outcome(finding, "reconstructor", recover_s=recover_s)


def given_up(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The same with the default policy: after five restarts the graph ends with a reason."""
    launch = graph_text({"restart_delay_s": 0, "restart_window_s": None})
    with GraphRun(launch, folder=folder) as graph:
        _kill_again_and_again(graph)
        code = graph.wait()
        finding = f"exit code {code}: {graph.wait_for('given up')}"
        return outcome_of(finding, graph.left_behind())


def _kill_again_and_again(graph: GraphRun) -> None:
    killed: set[int] = set()
    while graph.process.poll() is None and len(killed) < N_KILLS:
        pid = graph.nodes().get("reconstructor")
        if pid is None or pid in killed:
            time.sleep(0.01)
            continue
        killed.add(pid)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def full_disk(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The recorder's disk is full: it logs that, its file can be read, all other nodes go on."""
    disk = folder / "disk"
    with small_disk(disk):
        out = disk / "run.mcap"
        with ObservedGraph(graph_text(), "--record", str(out), folder=folder) as graph:
            line = graph.wait_for("No space left on device").replace(str(disk), "disk")
            time.sleep(point["seconds"])
            graph.probe.wait_for_frame(max_age_ns=math.inf)
            found = graph.outcome("", "recorder")
        n_recorded = _n_recorded(out.with_name("run.mcap.part"))
    return {**found, "finding": f"{n_recorded} messages can be read; {line}"}


def ten_times_the_rate(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The sensor publishes ten times as fast for a while, more than the solver can process."""
    slow = {"preset": "paper", "iterations": 40, "fast": "off"}
    rate_hz = point.get("rate_hz", RATE_HZ)
    launch = graph_text(sensor={"rate_hz": rate_hz}, reconstructor=slow)
    with ObservedGraph(launch, folder=folder) as graph:
        graph.probe.wait_for_frame(max_age_ns=math.inf)
        graph.begin()
        graph.ask("sensor", "set", {"rate_hz": 10 * rate_hz})
        time.sleep(point["seconds"])
        graph.ask("sensor", "set", {"rate_hz": rate_hz})
        recover_s = graph.probe.wait_for_frame()
        oldest_ns = max(seen.came_ns - seen.stamp_ns for seen in list(graph.probe.reconstructed))
        time.sleep(1.0)
        found = graph.outcome("", recover_s=recover_s)
        counted = graph.summary()["patches"]["skin"]["frames"]["lost"]
    finding = f"the graph itself counts {counted}; the oldest frame was {oldest_ns / 1e9:.1f} s old"
    return {**found, "finding": finding}


def stepped_clock(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The wall clock of every process steps back by an hour."""
    modules, switch = folder.resolve() / "modules", folder.resolve() / "stepped"
    modules.mkdir(parents=True)
    loaded = str(modules / "loaded-by-")
    text = _STEPPED.format(step_ns=STEP_NS, switch=str(switch), loaded=loaded)
    (modules / "sitecustomize.py").write_text(text)
    with ObservedGraph(
        *(graph_text(), "--record", "run.mcap"),
        folder=folder,
        environment={"PYTHONPATH": str(modules)},
    ) as graph:
        reached = {int(path.name.rpartition("-")[2]) for path in modules.glob("loaded-by-*")}
        if not set(graph.processes()) <= reached:
            raise GraphError("the stepped clock has not reached every process")
        graph.probe.wait_for_frame(max_age_ns=math.inf)
        graph.begin()
        switch.touch()
        recover_s = graph.probe.wait_for_frame(graph.began_ns, math.inf)
        time.sleep(point["seconds"])
        stamps = [seen.stamp_ns for seen in list(graph.probe.reconstructed)]
        back = sum(b <= a for a, b in itertools.pairwise(stamps))
        finding = f"in all {len(reached)} processes; {back} stamps of frames went back"
        return graph.outcome(finding, recover_s=recover_s)


def stepped_driver(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The stamps of a driver step back by an hour."""
    folder.mkdir(parents=True)
    (folder / "stepping.py").write_text(_DRIVER.format(step_ns=STEP_NS))
    launch = graph_text(sensor={"source": "stepping:frames", "rate_hz": None})
    with GraphRun(launch, folder=folder) as graph:
        code = graph.wait()
        return outcome_of(f"exit code {code}; {graph.wait_for('stamp_ns')}", graph.left_behind())


def stalled_subscribers(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """`N_STALLED` subscribers of the sensor and as many of the reconstructor never read."""
    with ObservedGraph(graph_text(), folder=folder) as graph, contextlib.ExitStack() as stack:
        # By then each node has allocated what it needs at first.
        graph.probe.wait_for_frame(max_age_ns=math.inf)
        nodes = graph.nodes()
        before = {name: own_bytes(pid) for name, pid in nodes.items()}
        graph.begin()
        for name in ("sensor", "reconstructor"):
            stack.enter_context(_stalled(graph.note()["nodes"][name]["endpoint"]))
        time.sleep(point["seconds"])
        recover_s = graph.probe.wait_for_frame(max_age_ns=math.inf)
        grew_mb = {name: (own_bytes(pid) - before[name]) / 1e6 for name, pid in nodes.items()}
        worst = max(grew_mb, key=lambda name: grew_mb[name])
        finding = f"memory grew by {grew_mb[worst]:.1f} MB at most ({worst})"
        return graph.outcome(finding, recover_s=recover_s)


@contextlib.contextmanager
def _stalled(endpoint: str) -> Iterator[None]:
    command = [sys.executable, "-c", _STALLED, str(N_STALLED), endpoint]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        yield
    finally:
        process.kill()
        process.communicate()


def refused_readers(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Readers with a key that is not on the list, with a wrong key of the host, and with none; one
    with the key of the graph reads on.
    """
    for name in ("edge", "lab"):
        make_key_files(name, folder / "keys")
    edge, lab = (read_key_pair(folder / f"keys/{name}.key") for name in ("edge", "lab"))
    keys = dict(zip(_REFUSED, ((lab, edge.public), (edge, lab.public), (None, "")), strict=True))
    named_s, n_got = {}, 0
    launch = graph_text({"transport": "tcp"}) + _SECURITY
    with ObservedGraph(launch, folder=folder) as graph:
        graph.probe.wait_for_frame(max_age_ns=math.inf)
        graph.begin()
        for kind, (own, server_key) in keys.items():
            named_s[kind], got = _read_without_right(graph, own, server_key, _REFUSED[kind])
            n_got += got
        graph.probe.wait_for_frame(max_age_ns=math.inf)
        times = ", ".join(f"{kind} {seconds:.2f} s" for kind, seconds in named_s.items())
        return graph.outcome(f"{n_got} messages came to them; named after: {times}")


def _read_without_right(
    graph: GraphRun, own: KeyPair | None, server_key: str, words: str
) -> tuple[float, int]:
    """Subscribe to the sensor; seconds until the log holds `words`; messages read."""
    context = make_context()
    try:
        reader = Reader(context, "stranger", (), ["/skin/taxels"], present=False, keys=own)
        reader.connect(graph.note()["nodes"]["sensor"]["endpoint"], server_key)

        def is_named() -> bool:
            return any(words in line for line in graph.log)

        seconds = wait_until(is_named, f"the line {words!r} in the log")
        time.sleep(GET_S)
        n_got = 0
        while reader.receive() is not None:
            n_got += 1
        return seconds, n_got
    finally:
        context.destroy(linger=0)


class Case(NamedTuple):
    """A fault in words, and the function that makes it in a folder of its own."""

    title: str
    make: Callable[[dict[str, Any], Path], dict[str, Any]]


CASES = {
    "launcher": Case("kill -9 of the launcher", launcher),
    "in a row": Case(
        "kill -9 of the reconstructor 20 times in a row, `max_restarts = 100`", in_a_row
    ),
    "given up": Case("the same with the default policy", given_up),
    "full disk": Case("the recorder's disk (1 MB) is full", full_disk),
    "rate": Case(
        "the sensor publishes at 10 times its rate for 3 s, more than the solver can process",
        ten_times_the_rate,
    ),
    "clock": Case("the wall clock steps back by 1 h", stepped_clock),
    "driver": Case("the stamps of a driver step back by 1 h", stepped_driver),
    "subscribers": Case(
        "100 subscribers of the sensor and 100 of the reconstructor never read",
        stalled_subscribers,
    ),
    "keys": Case(
        "readers with an unlisted key, a wrong key of the host and no key, on a secured graph",
        refused_readers,
    ),
}


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """Mount a disk of 1 MB while the context lasts.

    Raises
    ------
    NotPermittedError
        If mounting is not permitted here.
    """
    folder.mkdir(parents=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(folder)]
    done = subprocess.run(mount, capture_output=True, text=True, check=False)
    if done.returncode:
        raise NotPermittedError(f"no small disk could be mounted: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def _n_recorded(path: Path) -> int:
    with BagReader(path) as bag:
        return sum(info.n_messages for info in bag.topics.values())
