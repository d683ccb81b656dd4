"""Cost of introspecting a graph: `make introspection-load` (5 minutes).

A graph of 40 x 40 taxels at 1 kHz, with and without `topic echo`, `hz` and `bw` beside it, in turns
of one run: the latency from sensor to reconstruction, as a node of the graph itself reads it, and
the processor time of the graph's own processes. In the turns without, the three observers are
suspended, so that turns can be short: the load of a shared host changes. The graph is also measured
before they start and after they end.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.phi.rotation import FIXED
from sparseskin.nodes.process.proc import cpu_s
from sparseskin.studies.graph_run import GraphRun, launch_text

from .turns import LATENCIES, Turn, latencies_ms, take_turn

COMMANDS = (
    ("topic", "echo", "/skin/reconstruction"),
    ("topic", "hz", "/skin/taxels"),
    ("topic", "bw", "/skin/measurements"),
)
NONE, SUSPENDED, OBSERVED = "no observer", "suspended", "echo, hz and bw"
SETTLE_S = 0.5
DEPTH = 16
"""Frames that may wait: on a host that cannot reconstruct them all, the latency is that of those
which are reconstructed, not the length of a growing queue; and the run ends when it should.
"""


def launch_file(rate_hz: float) -> str:
    """Text of the launch file, the node that notes latencies included."""
    sensor = {"source": "sparseskin.studies.looped:path_40", "rate_hz": rate_hz}
    reconstructor = {"depth": DEPTH}
    compressor = {"rows": FIXED}
    nodes = launch_text(
        {"sensor": sensor, "compressor": compressor, "reconstructor": reconstructor}
    )
    return nodes + LATENCIES


@contextlib.contextmanager
def observers(graph: GraphRun) -> Iterator[Callable[[signal.Signals], None]]:
    """The commands beside the graph, each from its first line on; sends them all a signal."""
    own = set(graph.processes())
    with contextlib.ExitStack() as stack:
        for command in COMMANDS:
            process = graph.start(*command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
            assert process.stdout is not None
            process.stdout.readline()
            # Their output is read, as by a terminal; that costs the graph nothing.
            drain = subprocess.Popen(["cat"], stdin=process.stdout, stdout=subprocess.DEVNULL)
            for end in (drain.wait, process.wait, process.terminate):  # the last is called first
                stack.callback(end)

        def send(number: signal.Signals) -> None:
            for pid in set(graph.processes()) - own:
                os.kill(pid, number)

        stack.callback(send, signal.SIGCONT)
        yield send


def measure(n_turns: int, turn_s: float, rate_hz: float) -> None:
    """Print p50 and p99 of the latency of each way, and the ratio of neighbouring turns."""
    with GraphRun(launch_file(rate_hz)) as graph:
        pids = [graph.process.pid, *graph.nodes().values()]
        turns: list[Turn] = []

        def turn(way: str) -> None:
            turns.append(take_turn(way, SETTLE_S, turn_s, lambda: sum(map(cpu_s, pids))))

        for _ in range(n_turns // 4):
            turn(NONE)
        with observers(graph) as send:
            for _ in range(n_turns):
                send(signal.SIGCONT)
                turn(OBSERVED)
                send(signal.SIGSTOP)
                turn(SUSPENDED)
        for _ in range(n_turns // 4):
            turn(NONE)
        graph.end()
        times_ns = np.load(graph.folder / "latencies.npy")
        host = graph.summary()["nodes"]["reconstructor"]
    report(turns, latencies_ms(turns, times_ns))
    received, skipped = (sum(host[what].values()) for what in ("received", "skipped"))
    print(f"frames that reached the host: {received}, skipped there: {skipped}")


def report(turns: Sequence[Turn], found_ms: Sequence[npt.NDArray[np.float64]]) -> None:
    """Print the table of some turns, given the latencies of the frames of each in ms."""
    print(f"{'40 x 40':<20}{'frames':>8}{'p50 ms':>10}{'p99 ms':>10}{'CPU us a frame':>16}")
    p50s, overall, cpus = {}, {}, {}
    for way in (NONE, SUSPENDED, OBSERVED):
        of_way = [found for turn, found in zip(turns, found_ms, strict=True) if turn.way == way]
        overall[way], p99 = np.quantile(np.concatenate(of_way), [0.5, 0.99])
        n = sum(map(len, of_way))
        p50s[way] = np.array([np.median(found) for found in of_way])
        cpus[way] = 1e6 * sum(turn.cpu_s for turn in turns if turn.way == way) / n
        print(f"{way:<20}{n:>8}{overall[way]:>10.3f}{p99:>10.3f}{cpus[way]:>16.0f}")
    with_ms, without_ms = p50s[OBSERVED], p50s[SUSPENDED]
    # Each turn is compared with the one before it and the one after it.
    ratios = np.log(np.concatenate([with_ms / without_ms, with_ms[1:] / without_ms[:-1]]))
    error = np.std(ratios) / np.sqrt(len(with_ms))
    print(
        f"p50 with / without, {len(with_ms)} turns: x {np.exp(np.mean(ratios)):.3f} "
        f"+- {error:.1%} (mean of neighbours, standard error), median "
        f"{np.exp(np.median(ratios)):.3f}; of all frames x "
        f"{overall[OBSERVED] / overall[SUSPENDED]:.3f}; CPU x "
        f"{cpus[OBSERVED] / cpus[SUSPENDED]:.3f}"
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
