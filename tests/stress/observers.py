"""What looks at a graph from beside it: commands and bridges; and the latency meanwhile."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from stress.graphs import GraphRun

from sparseskin.messages import Message
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.process.proc import cpu_s
from sparseskin.nodes.settings import PatchSettings, setting

SETTLE_S, DOMAIN = 0.5, 97
"""Pause before each turn; DDS domain of the measurement: hardly that of a robot near by."""
COMMANDS = (
    ("topic", "echo", "/skin/reconstruction"),
    ("topic", "hz", "/skin/taxels"),
    ("topic", "hz", "/skin/measurements"),
)
BRIDGES = {
    "foxglove": ("foxglove: ", ["--port", "0"]),
    "ros2": ("ros2: ", ["--set", f"domain={DOMAIN}", "--set", "interface=lo"]),
}
"""Of each bridge the token before its address, and its options: each sends every frame."""


@dataclass(frozen=True)
class LatenciesSettings(PatchSettings):
    """Settings of the node that notes latencies."""

    out: str = setting("latencies.npy", "file to write")


class Latencies(Node[LatenciesSettings]):
    """Notes the stamp of each frame and the time when it was reconstructed, int64, ns."""

    Settings = LatenciesSettings
    patience_s = (
        0.05  # the times are in the messages: they can wait, and cost less together
    )

    def __init__(self, settings: LatenciesSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._times = array("q")

    @classmethod
    def inputs(cls, settings: LatenciesSettings) -> tuple[str, ...]:
        return (f"/{settings.patch}/reconstruction",)

    def step(self, message: Message) -> Iterable[Message]:
        self._times.extend((message.stamp_ns, message.done_ns))
        return ()

    def close(self, counts: dict[str, Any]) -> None:
        np.save(self.settings.out, np.array(self._times, dtype=np.int64).reshape(-1, 2))


LATENCIES = '\n[nodes.latencies]\ntype = "stress.observers:Latencies"\n'
"""Lines for a launch file: the latencies are written to latencies.npy in its folder."""


def in_turns(
    graph: GraphRun,
    suspend: Callable[[bool], None],
    pids: list[int],
    n_turns: int,
    turn_s: float,
) -> dict[str, float]:
    """Let a graph run in turns with and without what looks at it, and end it.

    `suspend` stops what looks at it (True) or lets it go on. Returns p50_ms and p99_ms of the age
    of a frame when it is reconstructed, with and without; ratio: geometric mean of the ratios of
    the medians of neighbouring turns, and its error; us_a_frame: processor time of `pids`.
    """
    turns: list[tuple[int, int, float]] = []
    for suspended in (False, True) * n_turns:
        suspend(suspended)
        time.sleep(SETTLE_S)
        began_ns, began_s = time.time_ns(), sum(map(cpu_s, pids))
        time.sleep(turn_s)
        turns.append((began_ns, time.time_ns(), sum(map(cpu_s, pids)) - began_s))
    suspend(False)
    graph.end()
    times_ns = np.load(graph.cwd / "latencies.npy")
    found = [_ages_ms(times_ns, began, ended) for began, ended, _ in turns]
    p50s = [np.array([np.median(ages) for ages in found[k::2]]) for k in (0, 1)]
    ratios = np.log(np.concatenate([p50s[0] / p50s[1], p50s[0][1:] / p50s[1][:-1]]))
    figures = {"ratio": float(np.exp(ratios.mean()))}
    figures["error"] = float(np.std(ratios) / np.sqrt(n_turns))
    for k, way in enumerate(("with", "without")):
        p50, p99 = np.quantile(np.concatenate(found[k::2]), [0.5, 0.99])
        figures |= {f"p50_ms {way}": p50, f"p99_ms {way}": p99}
    n_with, used_s = sum(map(len, found[::2])), sum(used for _, _, used in turns[::2])
    return {name: round(float(x), 3) for name, x in figures.items()} | {
        "us_a_frame": round(1e6 * used_s / n_with)
    }


def _ages_ms(times_ns: Any, began_ns: int, ended_ns: int) -> Any:
    stamps, done = times_ns.T
    return (done - stamps)[(stamps >= began_ns) & (stamps < ended_ns)] / 1e6


def suspending(pids: Iterable[int]) -> Callable[[bool], None]:
    """Return what suspends processes, and lets them go on."""
    pids = list(pids)

    def suspend(suspended: bool) -> None:
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):  # it has ended with its graph
                os.kill(pid, signal.SIGSTOP if suspended else signal.SIGCONT)

    return suspend


@contextlib.contextmanager
def commands(graph: GraphRun) -> Iterator[list[int]]:
    """`topic echo`, `hz` and `bw` beside a graph, each from its first line on; their processes."""
    own = set(graph.survivors())
    with contextlib.ExitStack() as stack:
        for command in COMMANDS:
            process = graph.start(
                *command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            )
            process.stdout.readline()
            # Their output is read, as by a terminal; that costs the graph nothing.
            drain = subprocess.Popen(
                ["cat"], stdin=process.stdout, stdout=subprocess.DEVNULL
            )
            # the last is called first
            for end in (
                drain.wait,
                process.wait,
                process.terminate,
            ):
                stack.callback(end)
        found = [pid for pid in graph.survivors() if pid not in own]
        stack.callback(suspending(found), False)
        yield found


@contextlib.contextmanager
def bridge(graph: GraphRun, kind: str) -> Iterator[tuple[list[int], int]]:
    """A bridge and a client that has read its first frame; their processes, and its node's."""
    token, options = BRIDGES[kind]
    own = set(graph.survivors())
    stated = ["--set", 'maps=["reconstruction"]', *options]
    made = graph.start(
        "bridge", kind, *stated, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    client = None
    try:
        lines = (line.decode(errors="replace") for line in made.stderr)
        line = next((line for line in lines if token in line), "")
        if not line:
            raise AssertionError(f"the bridge {kind} ended before it had an address")
        where = str(DOMAIN) if kind == "ros2" else line.partition(token)[2].split()[0]
        client = subprocess.Popen(
            [sys.executable, "-m", "stress.clients", kind, where],
            env=graph.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        if client.stdout.readline().strip() != b"reads":
            raise AssertionError(f"the client of {kind} read nothing")
        found = {pid: line for pid, line in graph.survivors().items() if pid not in own}
        (node,) = (
            pid for pid, line in found.items() if re.search(rf"run_node {kind}_", line)
        )
        yield list(found), node
    finally:
        for process in (client, made):
            if process is not None:
                process.kill()
                process.wait()
