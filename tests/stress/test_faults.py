"""Faults in a running graph, each really caused: nodes, launcher, disk, clock, rate, readers.

At full size each signal is sent to each node 3 times, in 7 graphs (25 minutes).
"""

import contextlib
import itertools
import math
import os
import signal
import statistics
import subprocess
import sys
import time

import pytest
from processes import wait_until
from stress.graphs import RATE_HZ, ObservedGraph, graph_text

from sparseskin.nodes.process.proc import cpu_s
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.studies.speed.host import own_bytes

STREAM = ("sensor", "compressor", "reconstructor")
NODES = (*STREAM, "monitor", "recorder")
SETTLE_S = 0.4
"""Time for frames before and after a fault, to see that the graph runs as it should."""
BEFORE_NS = 100_000_000
"""Time before a fault from which frames are counted."""
N_STALLED, N_KILLS = 100, 20
STEP_NS = 3600 * 10**9
#: Found by Python before any module of its own: the wall clock of a process, an hour back once a
#: file exists. The monotonic clock, which no step of the wall clock moves, is left as it is.
STEPPED = """
import os, time
open({loaded!r} + str(os.getpid()), "w").close()
_ns = time.time_ns
def _now(): return _ns() - {step_ns} * os.path.exists({switch!r})
time.time_ns = _now
time.time = lambda: _now() / 1e9
"""
#: Subscribers of all topics of an endpoint that never read: once they are connected, which goes on
#: in a thread of ZeroMQ's, the process stops itself, so that not even that thread reads.
STALLED = """
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


def strike(graph, node, number, stop_s, rate_hz):
    """Send a node a signal, and wait until the graph runs as before.

    recover_s: from the signal, or from SIGCONT, until the reconstruction of a frame acquired
    after it came, half a second old at most; of a monitor or recorder, until it runs again.
    lost: frames acquired and not reconstructed. not_sensed: frames due by the sensor's rate
    and not acquired. stopped: other nodes that stopped too.
    """
    probe, before = graph.probe, graph.nodes()
    restarts = graph.state().get(node, {}).get("restarts", 0)
    probe.wait_for_frame()
    time.sleep(SETTLE_S)
    began_ns = ended_ns = probe.now_ns()
    os.kill(before[node], number)
    if number == signal.SIGSTOP:
        time.sleep(stop_s)
        os.kill(before[node], signal.SIGCONT)
        ended_ns = probe.now_ns()
    if node in STREAM:
        recover_s = probe.wait_for_frame(ended_ns)
    if number != signal.SIGSTOP:
        wait_until(
            lambda: graph.state()[node]["restarts"] > restarts,
            f"a restart of the {node}",
        )
    wait_until(
        lambda: graph.state()[node]["condition"] == "running", f"the {node} to run"
    )
    if node not in STREAM:
        recover_s = (probe.now_ns() - ended_ns) / 1e9
    probe.wait_for_frame()
    time.sleep(SETTLE_S)
    since_ns = began_ns - BEFORE_NS
    until_ns = max(seen.stamp_ns for seen in list(probe.reconstructed))
    lost, n_sensed = probe.lost(since_ns)
    not_sensed = max(0, round((until_ns - since_ns) / 1e9 * rate_hz) - n_sensed)
    return {
        **{
            "recover_s": recover_s,
            "lost": lost,
            "stopped": graph.stopped(before, node),
        },
        "not_sensed": not_sensed if node == "sensor" else 0,
    }


def not_recorded(folder, sensed):
    """Number of frames in no recording, those of killed recorders included."""
    recorded = set()
    for path in folder.glob("run*.mcap*"):
        with BagReader(path) as bag:
            recorded |= {message.stamp_ns for message in bag.messages(["/skin/taxels"])}
    inside = {stamp for stamp in sensed if min(recorded) <= stamp <= max(recorded)}
    return len(inside - recorded)


@pytest.mark.parametrize(
    ("name", "transport"),
    [("SIGKILL", None), ("SIGKILL", "tcp"), ("SIGSEGV", None), ("SIGSTOP", None)],
)
def test_a_node_that_ends_takes_no_other_with_it(name, transport, full, note, tmp_path):
    n_graphs, repeats, stop_s, rate_hz = (
        (7, 3, 5.0, 100.0) if full else (1, 1, 1.0, 20.0)
    )
    dies = name != "SIGSTOP"
    struck = {node: [] for node in NODES}
    launch = graph_text({"transport": transport}, sensor={"rate_hz": rate_hz})
    for k in range(n_graphs):
        folder = tmp_path / str(k)
        with ObservedGraph(launch, "--record", "run.mcap", folder=folder) as graph:
            for node in NODES * repeats:
                struck[node].append(
                    strike(graph, node, signal.Signals[name], stop_s, rate_hz)
                )
            sensed = {seen.stamp_ns for seen in list(graph.probe.sensed)}
            graph.end()
            left = graph.left_behind()
        assert all(what.endswith(".mcap.part") for what in left)
        assert bool(not_recorded(folder, sensed)) == dies
        recordings = sorted(path.name for path in folder.glob("run*"))
        if not full:
            assert recordings == (
                ["run.mcap.part", "run.restart1.mcap"] if dies else ["run.mcap"]
            )
    for node, found in struck.items():
        assert not any(one["stopped"] for one in found), node
        lost = statistics.median(one["lost"] for one in found)
        # Monitor and recorder cost the stream nothing.
        assert bool(lost) == (dies and node in ("compressor", "reconstructor")), node
        times_s = [one["recover_s"] for one in found]
        least, median, most = min(times_s), statistics.median(times_s), max(times_s)
        note(
            fault=f"{name} of the {node}",
            transport=transport or "default",
            lost=lost,
            not_acquired=statistics.median(one["not_sensed"] for one in found),
            recovered_s=f"{median:.2f} ({least:.2f}..{most:.2f})",
        )


@pytest.fixture
def begun(tmp_path):
    """Start and observe a graph in an empty folder, from its first reconstruction on."""
    with contextlib.ExitStack() as stack:

        def begin(launch, *arguments, **options):
            made = ObservedGraph(
                launch, *arguments, folder=tmp_path / "graph", **options
            )
            graph = stack.enter_context(made)
            graph.probe.wait_for_frame(max_age_ns=math.inf)
            graph.begin()
            return graph

        yield begin


@pytest.fixture
def ended(note):
    """End a graph, note its figures by the fault: no other node ended, nothing is left behind."""

    def end(graph, fault, *but, **figures):
        found = graph.outcome(*but)
        note(fault=fault, **found._asdict(), **figures)
        assert (found.stopped, found.left) == ([], [])
        assert found.of > 0
        return found

    return end


@pytest.fixture
def held_s(full):
    """Time for which a fault lasts."""
    return 10.0 if full else 0.5


def test_nothing_outlives_a_launcher_that_is_killed(begun, note):
    graph = begun(graph_text(), "--record", "run.mcap")
    graph.process.kill()
    graph.process.wait()
    took_s = wait_until(lambda: not graph.survivors(), "the end of all nodes")
    # A note that is not locked belongs to a graph that is gone; the next command removes it.
    n_notes = len(list(graph.notes.iterdir()))
    graph.start("monitor", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).wait()
    n_recorded = recorded(graph.cwd / "run.mcap")
    note(
        fault="kill -9 of the launcher",
        recover_s=took_s,
        notes=n_notes,
        recorded=n_recorded,
    )
    assert n_recorded > 0
    assert graph.left_behind() == []


def recorded(path):
    """Number of messages that can be read of a recording."""
    with BagReader(path) as bag:
        return sum(info.n_messages for info in bag.topics.values())


def kill_again_and_again(graph):
    """Kill the reconstructor `N_KILLS` times, each time as soon as its process runs."""
    killed = set()
    while len(killed) < N_KILLS:
        assert graph.process.poll() is None
        pid = graph.nodes().get("reconstructor")
        if pid is None or pid in killed:
            time.sleep(0.01)
            continue
        killed.add(pid)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def test_a_node_that_is_killed_twenty_times_in_a_row_comes_back(begun, ended, full):
    first_s, longest_s = (0.25, 2) if full else (0, 0.05)
    delays = {"restart_delay_s": first_s, "restart_max_delay_s": longest_s}
    graph = begun(graph_text({"max_restarts": 100, "restart_window_s": None, **delays}))
    launcher_s = cpu_s(graph.process.pid)
    kill_again_and_again(graph)
    recover_s = graph.probe.wait_for_frame(graph.probe.now_ns(), math.inf)
    took_s = (graph.probe.now_ns() - graph.began_ns) / 1e9
    cpu = 100 * (cpu_s(graph.process.pid) - launcher_s) / took_s
    ended(
        *(graph, "kill -9 of the reconstructor 20 times in a row", "reconstructor"),
        finding=f"after {took_s:.0f} s, the launcher at {cpu:.0f} % of a core",
        recover_s=recover_s,
    )


def test_a_full_disk_costs_the_stream_no_frame(begun, ended, held_s, mount_disk):
    out = mount_disk("1m") / "run.mcap"
    graph = begun(graph_text(), "--record", str(out))
    line = graph.wait_for("No space left on device")
    time.sleep(held_s)
    graph.probe.wait_for_frame(max_age_ns=math.inf)
    found = ended(graph, "the recorder's disk (1 MB) is full", "recorder", finding=line)
    assert found.lost == 0
    assert recorded(out.with_name("run.mcap.part")) > 0
    assert "No space left on device; recording ended" in line


def test_ten_times_the_rate_loses_what_is_counted_and_then_it_is_as_before(
    begun, ended, full
):
    slow = {"preset": "paper", "iterations": 40, "fast": "off"}
    rate_hz = RATE_HZ if full else 20.0  # slow enough for the solver on a busy host
    graph = begun(graph_text(sensor={"rate_hz": rate_hz}, reconstructor=slow))
    graph.ask("sensor", "set", {"rate_hz": 10 * rate_hz})
    time.sleep(3.0 if full else 0.5)
    graph.ask("sensor", "set", {"rate_hz": rate_hz})
    recover_s = graph.probe.wait_for_frame()
    oldest_ns = max(
        seen.came_ns - seen.stamp_ns for seen in list(graph.probe.reconstructed)
    )
    time.sleep(1.0)
    finding = f"the oldest frame was {oldest_ns / 1e9:.1f} s old"
    found = ended(graph, "10 times the rate", finding=finding, recover_s=recover_s)
    assert graph.summary()["patches"]["skin"]["frames"]["lost"] == found.lost


def test_a_clock_that_steps_back_is_not_noticed(begun, ended, held_s, tmp_path):
    modules, switch = tmp_path / "modules", tmp_path / "stepped"
    modules.mkdir()
    loaded = str(modules / "loaded-by-")
    text = STEPPED.format(step_ns=STEP_NS, switch=str(switch), loaded=loaded)
    (modules / "sitecustomize.py").write_text(text)
    environment = {"PYTHONPATH": str(modules)}
    graph = begun(graph_text(), "--record", "run.mcap", environment=environment)
    reached = {
        int(path.name.rpartition("-")[2]) for path in modules.glob("loaded-by-*")
    }
    assert set(graph.survivors()) <= reached
    switch.touch()
    recover_s = graph.probe.wait_for_frame(graph.began_ns, math.inf)
    time.sleep(held_s)
    stamps = [seen.stamp_ns for seen in list(graph.probe.reconstructed)]
    assert all(b > a for a, b in itertools.pairwise(stamps))
    assert (
        ended(graph, "the wall clock steps back by 1 h", recover_s=recover_s).lost == 0
    )


@contextlib.contextmanager
def stalled(endpoint):
    """`N_STALLED` subscribers of an endpoint that never read."""
    command = [sys.executable, "-c", STALLED, str(N_STALLED), endpoint]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True)
    try:
        process.stdout.readline()
        yield
    finally:
        process.kill()
        process.communicate()


def test_subscribers_that_never_read_cost_the_stream_no_frame(begun, ended, held_s):
    graph = begun(graph_text())
    nodes = graph.nodes()
    before = {name: own_bytes(pid) for name, pid in nodes.items()}
    with contextlib.ExitStack() as stack:
        for name in ("sensor", "reconstructor"):
            stack.enter_context(stalled(graph.note()["nodes"][name]["endpoint"]))
        time.sleep(held_s)
        recover_s = graph.probe.wait_for_frame(max_age_ns=math.inf)
        grew_mb = max(
            (own_bytes(pid) - before[name]) / 1e6 for name, pid in nodes.items()
        )
        finding = f"memory grew by {grew_mb:.1f} MB at most"
        found = ended(
            graph, "100 subscribers each", finding=finding, recover_s=recover_s
        )
    assert found.lost == 0
