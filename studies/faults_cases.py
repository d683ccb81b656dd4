"""Faults of the whole: launcher, disk, clock, rate, readers; each done to a graph of its own."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sparseskin.nodes.recorder.bag_reader import BagReader

from .faults_keys import turned_away
from .faults_signals import RATE_HZ, graph_text
from .graph_probe import Probe
from .graph_run import GraphRun, wait_until
from .points import StudyError

N_STALLED = 100
N_KILLS = 20
STEP_S = 3600
DISK = "1m"
#: Found by Python before any module of its own: the wall clock of a process, an hour back once a
#: file is there. The monotonic clock, which no step of the wall clock moves, is left as it is.
_STEPPED = """
import os, time
open({loaded!r} + str(os.getpid()), "w").close()
_ns = time.time_ns
def _now(): return _ns() - {step_ns} * os.path.exists({switch!r})
time.time_ns = _now
time.time = lambda: _now() / 1e9
"""
#: A driver whose own stamps step back after a second, and one that floods its sensor.
_DRIVER = """
import time
import numpy as np

def frames():
    for k in range(10**9):
        time.sleep(0.01)
        yield time.monotonic_ns() - (k > 100) * {step_ns}, np.zeros((40, 40))
"""


def launcher(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The launcher is killed: every node notices and ends, and the recording stays readable."""
    with GraphRun(folder, graph_text(), "--record", "run.mcap") as graph:
        with Probe(graph) as probe:
            probe.wait_for_frame(probe.clock.now_ns())
        in_memory = graph.shared_memory()
        graph.process.kill()
        graph.process.wait()
        took_s = wait_until(lambda: not graph.processes(), "the end of all nodes")
        # A note that is not locked is of a graph that is gone; the next command clears it away.
        n_notes = len(list(graph.notes.iterdir()))
        graph.command("monitor")
        left = graph.left() + in_memory
    with BagReader(folder / "run.mcap") as bag:
        n_recorded = sum(info.n_messages for info in bag.topics.values())
    return _row(
        took_s, left=left, told=f"{n_recorded} messages recorded; {n_notes} notes cleared away"
    )


def in_a_row(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The reconstructor is killed `N_KILLS` times, each time as soon as its process is there."""
    more = "max_restarts = 100\nrestart_delay_s = {0}\nrestart_max_delay_s = {1}"
    text = graph_text(more.format(*point["delays_s"])).replace("restart_window_s = 1 ", "")
    with GraphRun(folder, text) as graph, Probe(graph, ("taxels", "reconstruction")) as probe:
        killed: set[int] = set()
        began_ns, others = probe.clock.now_ns(), dict(graph.nodes())
        launcher_s = cpu_s(graph.process.pid)
        while len(killed) < N_KILLS:
            pid = graph.nodes().get("reconstructor")
            if pid is None or pid in killed:
                time.sleep(0.01)
                continue
            killed.add(pid)
            os.kill(pid, signal.SIGKILL)
        last_ns = probe.clock.now_ns()
        recover_s = (probe.wait_for_frame(last_ns) - last_ns) / 1e9
        busy = (cpu_s(graph.process.pid) - launcher_s) / ((probe.clock.now_ns() - began_ns) / 1e9)
        stopped = graph.stopped(others, "reconstructor")
        lost, _ = probe.lost(began_ns)
        graph.end()
        return _row(
            recover_s,
            lost=lost,
            stopped=stopped,
            left=graph.left(),
            told=f"{N_KILLS} restarts in {(last_ns - began_ns) / 1e9:.0f} s, the launcher at "
            f"{100 * busy:.0f} % of a core",
        )


def given_up(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The same with the default policy: after five restarts the graph ends, and says why."""
    text = graph_text("restart_delay_s = 0").replace("restart_window_s = 1 ", "")
    with GraphRun(folder, text) as graph:
        killed: set[int] = set()
        while graph.process.poll() is None and len(killed) < N_KILLS:
            pid = graph.nodes().get("reconstructor")
            if pid is not None and pid not in killed:
                killed.add(pid)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        code = graph.wait()
        said = graph.wait_for("given up")
        return _row(None, left=graph.left(), told=f"exit code {code}: {said}")


def full_disk(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The recorder's disk is full: it says so, what it holds can be read, all others go on."""
    disk = folder / "disk"
    with small_disk(disk):
        out = disk / "run.mcap"
        with (
            GraphRun(folder, graph_text(), "--record", str(out)) as graph,
            Probe(graph, ("taxels", "reconstruction")) as probe,
        ):
            began_ns, others = probe.clock.now_ns(), dict(graph.nodes())
            said = graph.wait_for("No space left on device")
            time.sleep(point["seconds"])
            lost, n_sensed = probe.lost(began_ns)
            stopped = graph.stopped(others, "recorder")
            graph.end()
            left = graph.left()
        with BagReader(out.with_name("run.mcap.part")) as bag:
            n_recorded = sum(info.n_messages for info in bag.topics.values())
    return _row(
        None,
        lost=lost,
        of=n_sensed,
        stopped=stopped,
        left=left,
        told=f"{n_recorded} messages can be read; {said.replace(str(disk), 'disk')}",
    )


def ten_times_the_rate(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The sensor publishes ten times as fast for a while, beyond what the solver can take."""
    slow = 'preset = "paper"\niterations = 40\nfast = "off"'
    text = graph_text().replace('preset = "skin"', slow)
    with GraphRun(folder, text) as graph, Probe(graph, ("taxels", "reconstruction")) as probe:
        others = dict(graph.nodes())
        probe.wait_for_frame(probe.clock.now_ns())
        began_ns = probe.clock.now_ns()
        graph.ask("sensor", "set", {"rate_hz": 10 * RATE_HZ})
        time.sleep(point["seconds"])
        graph.ask("sensor", "set", {"rate_hz": RATE_HZ})
        ended_ns = probe.clock.now_ns()
        recovered_ns = probe.wait_for_fresh(ended_ns)
        recover_s = (recovered_ns - ended_ns) / 1e9
        oldest_s = max(seen.came_ns - seen.stamp_ns for seen in probe.seen()) / 1e9
        time.sleep(1.0)
        lost, n_sensed = probe.lost(began_ns)
        stopped = graph.stopped(others)
        graph.end()
        counted = graph.summary()["patches"]["skin"]["frames"]["lost"]
        return _row(
            recover_s,
            lost=lost,
            of=n_sensed,
            stopped=stopped,
            left=graph.left(),
            told=f"the graph itself counts {counted}; the oldest frame was {oldest_s:.1f} s old",
        )


def stepped_clock(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The wall clock of every process steps back by an hour."""
    modules, switch = folder / "modules", folder / "stepped"
    modules.mkdir(parents=True)
    loaded = str(modules / "loaded-by-")
    text = _STEPPED.format(step_ns=STEP_S * 10**9, switch=str(switch), loaded=loaded)
    (modules / "sitecustomize.py").write_text(text)
    environment = {"PYTHONPATH": str(modules.resolve())}
    with (
        GraphRun(folder, graph_text(), "--record", "run.mcap", environment=environment) as graph,
        Probe(graph, ("taxels", "reconstruction")) as probe,
    ):
        others = dict(graph.nodes())
        reached = {int(path.name.rpartition("-")[2]) for path in modules.glob("loaded-by-*")}
        if not set(graph.processes()) <= reached:
            raise StudyError("the stepped clock has not reached every process")
        probe.wait_for_frame(probe.clock.now_ns())
        began_ns = probe.clock.now_ns()
        switch.touch()
        recover_s = (probe.wait_for_frame(began_ns) - began_ns) / 1e9
        time.sleep(point["seconds"])
        lost, n_sensed = probe.lost(began_ns)
        stamps = [seen.stamp_ns for seen in probe.seen()]
        stopped = graph.stopped(others)
        graph.end()
        left = graph.left()
    back = sum(b <= a for a, b in itertools.pairwise(stamps))
    told = f"in all {len(reached)} processes; {back} stamps of frames went back"
    return _row(recover_s, lost=lost, of=n_sensed, stopped=stopped, left=left, told=told)


def stepped_driver(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The stamps of a driver step back by an hour."""
    folder.mkdir(parents=True)
    (folder / "stepping.py").write_text(_DRIVER.format(step_ns=STEP_S * 10**9))
    text = graph_text().replace("scene:path_40", "stepping:frames")
    with GraphRun(folder, text.replace(f"rate_hz = {RATE_HZ:g}", "")) as graph:
        code = graph.wait()
        said = graph.wait_for("stamp_ns")
        return _row(None, left=graph.left(), told=f"exit code {code}; {said}")


def stalled_subscribers(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """`N_STALLED` subscribers of the sensor and as many of the reconstructor never read."""
    with GraphRun(folder, graph_text()) as graph:
        endpoints = {name: node["endpoint"] for name, node in graph.note()["nodes"].items()}
        with Probe(graph, ("taxels", "reconstruction")) as probe, contextlib.ExitStack() as stack:
            probe.wait_for_fresh(probe.clock.now_ns())  # what a node makes at first is made by now
            others = dict(graph.nodes())
            before_mb = {name: memory_mb(pid) for name, pid in others.items()}
            began_ns = probe.clock.now_ns()
            for name in ("sensor", "reconstructor"):
                stack.enter_context(_stalled(endpoints[name]))
            time.sleep(point["seconds"])
            lost, n_sensed = probe.lost(began_ns)
            recover_s = (probe.wait_for_frame(now := probe.clock.now_ns()) - now) / 1e9
            grew_mb = {name: memory_mb(pid) - before_mb[name] for name, pid in others.items()}
            stopped = graph.stopped(others)
        graph.end()
        worst = max(grew_mb, key=lambda name: grew_mb[name])
        return _row(
            recover_s,
            lost=lost,
            of=n_sensed,
            stopped=stopped,
            left=graph.left(),
            told=f"memory grew by {grew_mb[worst]:.1f} MB at most ({worst})",
        )


CASES: dict[str, Callable[[dict[str, Any], Path], dict[str, Any]]] = {
    "launcher": launcher,
    "in a row": in_a_row,
    "given up": given_up,
    "full disk": full_disk,
    "rate": ten_times_the_rate,
    "clock": stepped_clock,
    "driver": stepped_driver,
    "subscribers": stalled_subscribers,
    "keys": turned_away,
}


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """A disk of 1 MB while the context lasts.

    Raises
    ------
    NotPermittedError
        If nothing may be mounted here.
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


class NotPermittedError(Exception):
    """A fault that cannot be made on this host; the text says why."""


def cpu_s(pid: int) -> float:
    """Seconds of processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int) -> float:
    """Memory of a process that is its own: what it shares is counted in shares, MB."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    kib = next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return kib * 1024 / 1e6


@contextlib.contextmanager
def _stalled(endpoint: str) -> Iterator[None]:
    command = [sys.executable, "-m", "sparseskin.studies.faults_stalled", str(N_STALLED), endpoint]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        yield
    finally:
        process.kill()
        process.communicate()


def _row(
    recover_s: float | None,
    *,
    lost: int = 0,
    of: int | None = None,
    stopped: list[str] | None = None,
    left: list[str],
    told: str,
) -> dict[str, Any]:
    return {
        "recover_s": [] if recover_s is None else [round(recover_s, 4)],
        "lost": lost,
        "of": of,
        "stopped": stopped or [],
        "left": left,
        "told": told,
    }
