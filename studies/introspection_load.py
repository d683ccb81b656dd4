"""What looking at a graph costs it: `make introspection-load` (5 minutes).

A graph of 40 x 40 taxels at 1 kHz, with and without `topic echo`, `hz` and `bw` beside it, turn by
turn in one run: the latency from sensor to reconstruction, as a node of the graph itself reads it,
and the processor time that the graph's own processes take. In the turns without, the three are
suspended, so that turns can be short: a host that others use is not the same for long. Before they
begin and after they end it is measured, too.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Message, Reconstruction
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.settings import PatchSettings, setting

from .graph_run import wait_until

COMMAND = [sys.executable, "-m", "sparseskin.launch.entry"]
LAUNCH = """
[nodes.sensor]
type = "sensor"
source = "sparseskin.studies.latency_nodes:path_40"
rate_hz = {rate_hz}
[nodes.compressor]
type = "compressor"
[nodes.reconstructor]
type = "reconstructor"
depth = {depth}
[nodes.latencies]
type = "sparseskin.studies.introspection_load:Latencies"
out = "{out}"
"""
COMMANDS = (
    ("topic", "echo", "/skin/reconstruction"),
    ("topic", "hz", "/skin/taxels"),
    ("topic", "bw", "/skin/measurements"),
)
NONE, SUSPENDED, LOOKED_AT = "nobody there", "suspended", "echo, hz and bw"
SETTLE_S = 0.5
DEPTH = 16
"""Frames that may wait: on a host that cannot restore them all, what is measured is the latency of
those that are restored, and not how long a queue has grown; and the run ends when it should.
"""


@dataclass(frozen=True)
class LatenciesSettings(PatchSettings):
    """Settings of the node that notes latencies."""

    out: str = setting("latencies.npy", "file to write")


class Latencies(Node[LatenciesSettings]):
    """Notes of each frame its stamp and the time when it was restored, int64, nanoseconds."""

    Settings = LatenciesSettings
    patience_s = 0.05  # the times are in the messages: they can wait, and cost less together

    def __init__(self, settings: LatenciesSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._times = array("q")

    @classmethod
    def inputs(cls, settings: LatenciesSettings) -> tuple[str, ...]:
        return (f"/{settings.patch}/reconstruction",)

    def step(self, message: Message) -> Iterable[Message]:
        assert isinstance(message, Reconstruction)
        self._times.extend((message.stamp_ns, message.done_ns))
        return ()

    def close(self, counts: dict[str, Any]) -> None:
        np.save(self.settings.out, np.array(self._times, dtype=np.int64).reshape(-1, 2))


class Onlookers:
    """Commands beside the graph, each from its first line on; they can be suspended."""

    def __init__(self, commands: Iterable[tuple[str, ...]]) -> None:
        self._commands = [
            subprocess.Popen([*COMMAND, *one], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
            for one in commands
        ]
        self._drains = []
        for process in self._commands:
            assert process.stdout is not None
            process.stdout.readline()
            # What they print is read on, as a terminal would; it costs the graph nothing.
            self._drains.append(
                subprocess.Popen(["cat"], stdin=process.stdout, stdout=subprocess.DEVNULL)
            )

    def suspend(self, suspended: bool) -> None:
        """Stop them all, or let them go on."""
        for process in self._commands:
            for pid in (process.pid, *children_of(process.pid)):
                os.kill(pid, signal.SIGSTOP if suspended else signal.SIGCONT)

    def __enter__(self) -> Onlookers:
        return self

    def __exit__(self, *_: object) -> None:
        self.suspend(False)
        for process in self._commands:
            process.terminate()
        for process in [*self._commands, *self._drains]:
            process.wait()


@dataclass(frozen=True)
class Turn:
    """One stretch of time, ns on the graph's clock, and the processor time of the graph in it."""

    way: str
    began_ns: int
    ended_ns: int
    cpu_s: float


def children_of(pid: int) -> list[int]:
    """Processes that a process has begun and that are still there."""
    return [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def cpu_of(pid: int) -> float:
    """Processor time in seconds that a launcher and its nodes have used."""
    ticks = 0
    for one in (pid, *children_of(pid)):
        fields = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def measure(turns: int, turn_s: float, rate_hz: float) -> None:
    """Print p50 and p99 of the latency of each way, and the ratio of neighbouring turns."""
    with tempfile.TemporaryDirectory() as folder:
        out, launch = Path(folder) / "latencies.npy", Path(folder) / "load.toml"
        launch.write_text(LAUNCH.format(out=out, rate_hz=rate_hz, depth=DEPTH))
        said, summary = Path(folder) / "stderr.txt", Path(folder) / "summary.json"
        command = [*COMMAND, "launch", str(launch), "--summary", str(summary)]
        # Into a file: nobody reads while it is measured, and a pipe that is full would stop it.
        with said.open("w") as err:
            graph = subprocess.Popen(command, stderr=err, stdout=subprocess.DEVNULL)
        wait_until(lambda: "ready:" in said.read_text(), "the graph to be ready")
        spans: list[Turn] = []

        def turn(way: str) -> None:
            time.sleep(SETTLE_S)
            began_ns, cpu_s = time.time_ns(), cpu_of(graph.pid)
            time.sleep(turn_s)
            spans.append(Turn(way, began_ns, time.time_ns(), cpu_of(graph.pid) - cpu_s))

        try:
            for _ in range(turns // 4):
                turn(NONE)
            with Onlookers(COMMANDS) as onlookers:
                for _ in range(turns):
                    for way in (LOOKED_AT, SUSPENDED):
                        onlookers.suspend(way == SUSPENDED)
                        turn(way)
            for _ in range(turns // 4):
                turn(NONE)
        finally:
            graph.terminate()
            graph.wait()
        stamps, done = np.load(out).T
        host = json.loads(summary.read_text())["nodes"]["reconstructor"]
    report(spans, stamps, (done - stamps) / 1e6)
    received, skipped = (sum(host[what].values()) for what in ("received", "skipped"))
    print(f"frames that reached the host: {received}, skipped there: {skipped}")


def report(
    turns: list[Turn],
    stamps: npt.NDArray[np.int64],
    latency_ms: npt.NDArray[np.float64],
) -> None:
    """Print the table.

    Parameters
    ----------
    turns : list of Turn
        The turns.
    stamps : ndarray of int64, shape (n_frames,)
        Stamps, ns.
    latency_ms : ndarray of float64, shape (n_frames,)
        Latency of each frame, ms.
    """
    inside = [latency_ms[(stamps >= t.began_ns) & (stamps < t.ended_ns)] for t in turns]
    print(f"{'40 x 40':<20}{'frames':>8}{'p50 ms':>10}{'p99 ms':>10}{'CPU us a frame':>16}")
    p50s, overall, cpus = {}, {}, {}
    for way in (NONE, SUSPENDED, LOOKED_AT):
        of_way = [found for turn, found in zip(turns, inside, strict=True) if turn.way == way]
        p50, p99 = np.quantile(np.concatenate(of_way), [0.5, 0.99])
        n = sum(map(len, of_way))
        overall[way] = p50
        p50s[way] = np.array([np.median(found) for found in of_way])
        cpus[way] = 1e6 * sum(turn.cpu_s for turn in turns if turn.way == way) / n
        print(f"{way:<20}{n:>8}{p50:>10.3f}{p99:>10.3f}{cpus[way]:>16.0f}")
    with_ms, without_ms = p50s[LOOKED_AT], p50s[SUSPENDED]
    # Each turn is compared with the one before it and the one after it.
    ratios = np.log(np.concatenate([with_ms / without_ms, with_ms[1:] / without_ms[:-1]]))
    error = np.std(ratios) / np.sqrt(len(with_ms))
    print(
        f"p50 with / without, {len(with_ms)} turns: x {np.exp(np.mean(ratios)):.3f} "
        f"+- {error:.1%} (mean of neighbours, standard error), median "
        f"{np.exp(np.median(ratios)):.3f}; of all frames x "
        f"{overall[LOOKED_AT] / overall[SUSPENDED]:.3f}; CPU x "
        f"{cpus[LOOKED_AT] / cpus[SUSPENDED]:.3f}"
    )


def main() -> None:
    """Read the options, and measure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--turns", type=int, default=60, help="turns with, and as many without")
    parser.add_argument("--seconds", type=float, default=1.0, help="length of a turn")
    parser.add_argument("--rate-hz", type=float, default=1000.0, help="frames a second")
    arguments = parser.parse_args()
    measure(arguments.turns, arguments.seconds, arguments.rate_hz)


if __name__ == "__main__":
    main()
