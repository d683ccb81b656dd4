"""What a frame costs in each bridge, and the latency of the graph with and without it, in turns."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sparseskin.messages import Reconstruction, SkinState
from sparseskin.nodes.clock import SystemClock, wall_offset_ns
from sparseskin.nodes.node import Context
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.process.proc import cpu_s
from sparseskin.nodes.registry import make_settings, node_class
from sparseskin.studies.graph_run import GraphRun, launch_text
from sparseskin.studies.points import StudyError, compute
from sparseskin.studies.report import fill_page, markdown, write_csv
from sparseskin.studies.streaming.turns import LATENCIES, Turn, latencies_ms, take_turn

SCENE, RATE_HZ = "drag_wrench_64", 200
DOMAIN = 97
"""DDS domain of the measurement: hardly that of a robot near by."""
SETTLE_S = 0.5
WITHOUT, WITH = "without", "with"
ALL_FRAMES = "rate_hz=0"
BRIDGES = {
    "foxglove": ("foxglove: ", ["--port", "0"], "image, grid, figures"),
    "ros2": ("ros2: ", ["--set", f"domain={DOMAIN}"], "image, points, array"),
    "lerobot": ("lerobot: ", ["--port", "0", "--set", ALL_FRAMES], "PNG of every frame"),
    "lerobot, 30 Hz": ("lerobot: ", ["--port", "0"], "PNG at 30 Hz"),
}
"""Of each row the token before its address, its options, and what it sends of a reconstruction."""


_QUIET: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
N_STEPS, WARM_UP = 3000, 500
STEP_S, STAMP_NS = 0.001, 1_000_000
"""Time between two frames where single steps are timed: the client keeps up with them."""
BEFORE_NS, BETWEEN_NS = 10**15, 10**8
"""Stamp of the first frame that is sent until the client reads, beyond all that it counts, and time
between two: a bridge that sends 30 frames a second sends each.
"""
HISTORY = 1000
"""Samples that DDS keeps, so that a reader which does not run for a second loses none."""
ENDS_S = 60.0


class _Beside(NamedTuple):
    """A bridge and its client beside a graph: their processes, and that of the bridge's node."""

    pids: set[int]
    node: int

    def send(self, number: signal.Signals) -> None:
        for pid in self.pids:
            os.kill(pid, number)


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """One bridge with one client beside a graph, in turns with both suspended.

    `point`: bridge, n_turns, turn_s, rate_hz, seed.

    Returns
    -------
    dict
        us_a_frame, processor time of the bridge's process for each frame of the graph; p50_ms and
        p99_ms of the age of a frame when it is reconstructed, WITHOUT and WITH; ratio of the p50 of
        neighbouring turns and its standard error; frames and dropped, of the bridge.
    """
    sensor = {"source": f"sparseskin.studies.looped:{SCENE}", "rate_hz": point["rate_hz"]}
    launch = launch_text({"sensor": sensor, "compressor": {}, "reconstructor": {"depth": 16}})
    with GraphRun(launch + LATENCIES) as graph, _beside(graph, point["bridge"]) as beside:
        turns: list[Turn] = []
        for _ in range(point["n_turns"]):
            for way, number in ((WITH, signal.SIGCONT), (WITHOUT, signal.SIGSTOP)):
                beside.send(number)
                turns.append(take_turn(way, SETTLE_S, point["turn_s"], lambda: cpu_s(beside.node)))
        beside.send(signal.SIGCONT)
        graph.end()
        times_ns = np.load(graph.folder / "latencies.npy")
    found = latencies_ms(turns, times_ns)
    p50s = {
        way: np.array([np.median(f) for t, f in zip(turns, found, strict=True) if t.way == way])
        for way in (WITH, WITHOUT)
    }
    ratios = np.log(
        np.concatenate([p50s[WITH] / p50s[WITHOUT], p50s[WITH][1:] / p50s[WITHOUT][:-1]])
    )
    figures: dict[str, Any] = {
        "ratio": round(float(np.exp(ratios.mean())), 4),
        "error": round(float(np.std(ratios) / np.sqrt(len(p50s[WITH]))), 4),
    }
    for way in (WITHOUT, WITH):
        ages = np.concatenate([f for t, f in zip(turns, found, strict=True) if t.way == way])
        p50, p99 = np.quantile(ages, [0.5, 0.99])
        figures |= {f"p50_ms {way}": round(p50, 3), f"p99_ms {way}": round(p99, 3)}
    n_with = sum(len(f) for t, f in zip(turns, found, strict=True) if t.way == WITH)
    used_s = sum(t.cpu_s for t in turns if t.way == WITH)
    return {**figures, "us_a_frame": round(1e6 * used_s / n_with, 1), "n_frames": n_with}


def steps(point: dict[str, Any]) -> dict[str, Any]:
    """Processor time of the thread that sends a reconstruction of 64 x 64 taxels to one client.

    `point`: bridge, n_steps, seed. Returns step_us, the median over all frames but the first.
    """
    used_us: list[float] = []
    with _connected(point) as (send, _):
        while len(used_us) < point["n_steps"]:
            began_ns = time.thread_time_ns()
            send(time.time_ns())
            used_us.append((time.thread_time_ns() - began_ns) / 1e3)
            time.sleep(STEP_S)
    return {"step_us": round(float(np.median(used_us[WARM_UP:])), 1)}


def counted(point: dict[str, Any]) -> dict[str, Any]:
    """Frames of 64 x 64 taxels at 1 kHz to a client that counts them.

    `point`: bridge, n_counted, seed.

    Returns
    -------
    dict
        counted_hz, the rate that was reached; received, the frames that the client has read;
        dropped, those that the bridge has counted as dropped. The client sees all others by a gap
        of their stamps.
    """
    n = point["n_counted"]
    with _connected(point, str(n)) as (send, client):
        begin_s = time.perf_counter()
        for k in range(1, n + 1):
            time.sleep(max(0.0, begin_s + k * STEP_S - time.perf_counter()))
            dropped = send(k * STAMP_NS)
        took_s = time.perf_counter() - begin_s
        end_s = time.monotonic() + ENDS_S
        # The last frame ends the client: it is sent again in case it was replaced.
        while client.poll() is None and time.monotonic() < end_s:
            send(n * STAMP_NS)
            time.sleep(SETTLE_S / 10)
        text = client.stdout.read() if client.stdout is not None else b""
        if client.poll() is None or not text:
            raise StudyError(f"{point['bridge']}: the client did not read the last frame")
    return {"counted_hz": round(n / took_s, 1), "received": int(text), "dropped": dropped}


@contextlib.contextmanager
def _connected(
    point: dict[str, Any], *arguments: str
) -> Iterator[tuple[Callable[[int], int], subprocess.Popen[bytes]]]:
    """A bridge in this process, and a client in another that has read its first frame.

    Yields what sends a frame by its stamp in ns and returns the number of dropped ones, and the
    client.
    """
    token, options, _ = BRIDGES[point["bridge"]]
    kind = token.partition(":")[0]
    values: dict[str, Any] = {"maps": ("reconstruction",)}
    values |= {"domain": DOMAIN, "history": HISTORY} if kind == "ros2" else {"port": 0}
    values |= {"rate_hz": 0.0} if ALL_FRAMES in options else {}
    cls = node_class(kind)
    node: Any = cls(make_settings(cls, values), Context(kind, SystemClock(wall_offset_ns())))
    rng = np.random.default_rng(point["seed"])
    forces = rng.uniform(0, 2.5, (64, 64)).astype(np.float32)

    def send(stamp_ns: int) -> int:
        list(node.step(_reconstruction(stamp_ns, forces)))
        return int(node.n_dropped)

    client = None
    try:
        list(node.start())
        list(node.step(_skin()))
        where = str(DOMAIN) if kind == "ros2" else node.where()
        module = "sparseskin.studies.bridges.clients"
        client = subprocess.Popen([sys.executable, "-m", module, kind, where, *arguments], **_QUIET)
        assert client.stdout is not None
        os.set_blocking(client.stdout.fileno(), False)
        for k in itertools.count():
            if client.stdout.read():
                break
            send(BEFORE_NS + k * BETWEEN_NS)
            if client.poll() is not None:
                raise StudyError(f"the client of {kind} has ended")
            time.sleep(STEP_S)
        os.set_blocking(client.stdout.fileno(), True)
        yield send, client
    finally:
        if client is not None:
            client.kill()
            client.wait()
        node.close({})


def _skin() -> SkinState:
    return SkinState(
        stamp_ns=0, patch="skin", n_rows=64, n_cols=64, f_max=2.5, unit="N", pitch_m=0.005,
        mask=None, source="study", seed=0, rate_hz=0.0, has_truth=False, sigma_mid=0.0,
        sigma_end=0.0,
    )  # fmt: skip


def _reconstruction(stamp_ns: int, forces: Floats) -> Reconstruction:
    return Reconstruction(
        stamp_ns=stamp_ns, patch="skin", forces=forces, phi="0" * 16, iterations=1, residual=0.0,
        solve_ns=0, done_ns=stamp_ns,
    )  # fmt: skip


@contextlib.contextmanager
def _beside(graph: GraphRun, name: str) -> Iterator[_Beside]:
    """A bridge and a client that has read its first frame."""
    token, options, _ = BRIDGES[name]
    kind = name.partition(",")[0]
    own = set(graph.processes())
    stated = ["--set", 'maps=["reconstruction"]', *options]
    pipes: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    bridge = graph.start("bridge", kind, *stated, **pipes)
    client = None
    try:
        address = ""
        assert bridge.stderr is not None
        for line in bridge.stderr:
            if token in (text := line.decode(errors="replace")):
                address = text.partition(token)[2].split()[0]
                break
        if not address:
            raise StudyError(f"the bridge {name} ended before it had an address")
        where = str(DOMAIN) if kind == "ros2" else address
        command = [sys.executable, "-m", "sparseskin.studies.bridges.clients", kind, where]
        environment = graph.environment
        client = subprocess.Popen(command, env=environment, **_QUIET)
        assert client.stdout is not None
        if client.stdout.readline().strip() != b"reads":
            raise StudyError(f"the client of {name} read nothing")
        # What the bridge still logs is read by nobody: it is less than a pipe holds.
        found = {pid: line for pid, line in graph.processes().items() if pid not in own}
        (node,) = (pid for pid, line in found.items() if re.search(rf"run_node {kind}_", line))
        yield _Beside(set(found), node)
    finally:
        for process in (client, bridge):
            if process is not None:
                process.kill()
                process.wait()


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Each bridge once."""
    n_turns = 4 if quick else 30
    common = {"n_turns": n_turns, "turn_s": 1.0, "rate_hz": RATE_HZ, "seed": seed}
    return [{"bridge": name, **common} for name in BRIDGES]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Measure each bridge, one after the other, and write the page; see `command.Study`.

    `executor` is not used: graphs at the same time would measure each other.
    """
    made = points(quick, seed)
    found = compute(measure, made, out, "serial", "bridges")
    single = [{"bridge": p["bridge"], "n_steps": N_STEPS, "seed": seed} for p in made]
    timed = compute(steps, single, out, "serial", "steps of bridges")
    n_counted = 500 if quick else 10_000
    every = [name for name in BRIDGES if "Hz" not in name]
    counts = [{"bridge": name, "n_counted": n_counted, "seed": seed} for name in every]
    kept = pd.DataFrame([
        {"bridge": p["bridge"], "sent": n_counted, **f}
        for p, f in zip(counts, compute(counted, counts, out, "serial", "counts"), strict=True)
    ])  # fmt: skip
    kept["missing"] = kept["sent"] - kept["received"] - kept["dropped"]
    rows = pd.DataFrame([
        {"bridge": p["bridge"].partition(",")[0], "sends": BRIDGES[p["bridge"]][2], **f, **t}
        for p, f, t in zip(made, found, timed, strict=True)
    ])  # fmt: skip
    headings = {
        "step_us": "us a step", "us_a_frame": "us a frame", "p50_ms without": "p50 without ms",
        "p50_ms with": "p50 with ms", "p99_ms without": "p99 without ms",
        "p99_ms with": "p99 with ms", "ratio": "p50 with / without", "error": "standard error",
    }  # fmt: skip
    table = rows[["bridge", "sends", *headings]].rename(columns=headings)
    formats = dict.fromkeys(headings.values(), ".2f")
    formats |= {
        "us a step": ".0f",
        "us a frame": ".0f",
        "p50 with / without": ".3f",
        "standard error": ".3f",
    }
    worst = rows.loc[rows["ratio"].idxmax()]
    dearest = rows.loc[rows["us_a_frame"].idxmax()]
    fill_page(
        out,
        "bridges",
        conclusion=[
            f"The dearest, {dearest['bridge']} ({dearest['sends']}), uses "
            f"{dearest['us_a_frame']:.0f} us of a core for each frame of 64 x 64 taxels.",
            f"The median latency of the graph is at most x {worst['ratio']:.3f} "
            f"(+- {worst['error']:.3f}) of that without: {worst['bridge']}, {worst['sends']}.",
            "No node waits for a bridge: what it costs the graph is its share of the cores, and "
            "that of its client, which is counted in here.",
        ],
        scene=SCENE,
        rate_hz=RATE_HZ,
        n_turns=made[0]["n_turns"],
        n_steps=N_STEPS - WARM_UP,
        cores=len(os.sched_getaffinity(0)),
        table=markdown(table, formats),
        kept=markdown(
            kept.rename(columns={"counted_hz": "Hz", "dropped": "counted as dropped"}),
            {"Hz": ".0f"},
        ),
        csv=write_csv(out, "bridges", rows),
    )
