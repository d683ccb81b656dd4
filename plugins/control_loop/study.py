"""Study `control-loop`: the age of forces in a loop, by the way in which it gets them."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pandas as pd

from sparseskin import nodes
from sparseskin.launch.attach.client import ask_node, stop
from sparseskin.launch.run.running import RunningGraph, choose_graph
from sparseskin.studies.points import StudyError
from sparseskin.studies.report import Page, markdown

from .ages import CONTACTS, DOMAIN, LOOPBACK, RATE_HZ

WAYS = {
    "stream": "`Stream` in the process (forces, no contacts)",
    "cpp": "C++, the newest",
    "subscribe": "`subscribe(newest=True)`",
    "ros2": "ROS 2 bridge, by DDS",
    "echo": "`topic echo --json`, by a pipe",
}
N_ROUNDS = 10
QUICK_ROUNDS = 2
N_MESSAGES = 20 * RATE_HZ
"""Messages of each way in a round. They are counted, so that a busy host measures as many."""
QUICK_MESSAGES = 6 * RATE_HZ
N_WARM_UP = 3 * RATE_HZ
"""First messages of a round, left out: a program imports, compiles and fills its caches."""
SPARSESKIN = (sys.executable, "-m", "sparseskin")
COMPARED = "echo"
"""The way with whose p50 in the same round each other one is compared."""
GRAPH = f"""\
[nodes.sensor]
type = "sensor"
source = "sparseskin.studies.looped:path_40"
rate_hz = {RATE_HZ}

[nodes.compressor]
type = "compressor"

[nodes.reconstructor]
type = "reconstructor"
contacts = true
"""


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Measure the ages, write the page and return its conclusion; see `command.Study`. They are
    measured anew each time, on this host; neither `seed` nor `executor` is used.
    """
    n_rounds = QUICK_ROUNDS if quick else N_ROUNDS
    n_messages = QUICK_MESSAGES if quick else N_MESSAGES
    rows, absent = _measured(n_rounds, n_messages)
    table = summary(pd.DataFrame(rows))
    page = Page(out, "control-loop", Path(__file__).with_suffix(".md"), quick)
    cores = len(os.sched_getaffinity(0))
    forms = {
        "p50, ms": ".2f",
        "p99, ms": ".2f",
        "p50 to echo": ".3f",
    }
    page.section(
        "",
        markdown(table, forms),
        rate_hz=RATE_HZ,
        n_rounds=n_rounds,
        n_messages=n_messages,
        cores=cores,
        n_warm_up=N_WARM_UP,
        absent="; ".join(absent) or "none",
    )
    page.csv("ages", rows)
    lines = []
    for row in table.to_dict("records"):
        lines.append(
            f"{row['way']}: p50 {row['p50, ms']:.2f} ms, p99 {row['p99, ms']:.2f} ms."
        )
    page.write(lines)
    return lines


def _measured(n_rounds: int, n_messages: int) -> tuple[list[dict[str, Any]], list[str]]:
    """A row for each age, and the ways that are absent on this host."""
    rows: list[dict[str, Any]] = []
    with ExitStack() as stack:
        # Programs, logs and the runtime folder go with it.
        temporary = tempfile.TemporaryDirectory(prefix="sparseskin-loop-")
        folder = Path(stack.enter_context(temporary))
        graph = stack.enter_context(running(folder))
        commands, absent = ways(folder, graph, n_messages)
        if "ros2" in commands:
            stack.enter_context(bridge(folder))
        # The ways alternate, so that a slow minute of the host is in all of them.
        for number in range(n_rounds):
            for way, words in commands.items():
                # Nothing else runs beside a loop that has the skin in its own process.
                ask_node(graph, "sensor", "pause", way == "stream")
                for age_ms in ages_of(way, words, folder):
                    rows.append(
                        {
                            "round": number,
                            "way": way,
                            "age_ms": age_ms,
                        }
                    )
    return rows, absent


@contextmanager
def running(folder: Path) -> Iterator[RunningGraph]:
    """A graph of the study, in a runtime folder of its own."""
    # A runtime folder of its own: no other graph is measured, or stopped.
    (folder / "loop.toml").write_text(GRAPH)
    folder_before = os.environ.get("SPARSESKIN_RUNTIME_DIR")
    os.environ["SPARSESKIN_RUNTIME_DIR"] = str(folder / "graphs")
    launch = subprocess.Popen(
        [*SPARSESKIN, "launch", "loop.toml"],
        cwd=folder,
        stderr=subprocess.PIPE,
        text=True,
    )
    with launch as process:
        try:
            assert process.stderr is not None
            if not any("[launch] ready" in line for line in process.stderr):
                raise StudyError(
                    f"the graph ended with {process.wait()} before it was ready"
                )
            # What it logs later is read, lest it waits for a reader.
            Thread(target=process.stderr.read, daemon=True).start()
            graph = choose_graph(None)
            yield graph
            stop(graph)
        finally:
            process.terminate()
            if folder_before is None:
                del os.environ["SPARSESKIN_RUNTIME_DIR"]
            else:
                os.environ["SPARSESKIN_RUNTIME_DIR"] = folder_before


@contextmanager
def bridge(folder: Path) -> Iterator[None]:
    """The bridge to ROS 2, on the loopback interface alone."""
    words = [*SPARSESKIN, "bridge", "ros2"]
    settings = (f"domain={DOMAIN}", f"interface={LOOPBACK}", 'maps=["reconstruction"]')
    for setting in settings:
        words += ["--set", setting]
    log = (folder / "bridge.log").open("w")
    with (
        log,
        subprocess.Popen(
            words,
            cwd=folder,
            stdout=log,
            stderr=log,
        ) as process,
    ):
        try:
            yield
        finally:
            process.terminate()


def ways(
    folder: Path, graph: RunningGraph, n_messages: int
) -> tuple[dict[str, list[str]], list[str]]:
    """Command of each way that this host has, and why it lacks the others."""
    commands: dict[str, list[str]] = {}
    absent: list[str] = []
    for way in WAYS:
        # The program in C++ is compiled here, and reads the socket of the node itself.
        if way == "cpp":
            program, why = compiled(folder)
            endpoint = graph.nodes[graph.writers()[CONTACTS]].endpoint
            words = [program, endpoint, str(graph.offset_ns), str(n_messages)]
        else:
            why = ""
            if way == "ros2" and find_spec("cyclonedds") is None:
                why = "cyclonedds is not installed"
            words = [sys.executable, "-m", f"{__package__}.ages", way, str(n_messages)]
        if why:
            absent.append(f"{WAYS[way]}: {why}")
        else:
            commands[way] = words
    return commands, absent


def compiled(folder: Path) -> tuple[str, str]:
    """The program in C++ that reads contacts; and why there is none, "" if there is one."""
    sources = Path(nodes.__path__[0]).resolve().parent / "examples" / "cpp"
    if not sources.is_dir():
        return "", "is in the repository, not in the package"
    if shutil.which("g++") is None:
        return "", "g++ is not installed"
    program = str(folder / "ages")
    source = str(sources / "ages.cpp")
    words = ["g++", "-std=c++17", "-O2", source, "-o", program, "-lzmq"]
    compiler = subprocess.run(
        words,
        capture_output=True,
        text=True,
        check=False,
    )
    if compiler.returncode:
        return program, "libzmq3-dev is not installed"
    return program, ""


def ages_of(way: str, words: list[str], folder: Path) -> list[float]:
    """Ages that a program prints, ms, without its first `N_WARM_UP`."""
    program = subprocess.run(
        words,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    ages_ms = [float(line) for line in program.stdout.split()]
    if program.returncode or len(ages_ms) <= N_WARM_UP:
        raise StudyError(
            f"{WAYS[way]}: ended with {program.returncode}: {program.stderr[-500:]}"
        )
    return ages_ms[N_WARM_UP:]


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each way: quantiles of the ages of all rounds; mean over the rounds of its p50 in
    parts of that of `COMPARED`.
    """
    p50s = rows.groupby(["way", "round"])["age_ms"].median().unstack("round")
    summaries = []
    for way, text in WAYS.items():
        if way not in p50s.index:
            continue
        ages_ms = rows.loc[rows["way"] == way, "age_ms"]
        # Ratios of one round: both ran on the same host at about the same time.
        ratio = float(np.mean(p50s.loc[way] / p50s.loc[COMPARED]))
        p50, p99 = np.quantile(ages_ms, [0.5, 0.99])
        figures = {
            "p50, ms": float(p50),
            "p99, ms": float(p99),
            "p50 to echo": ratio,
        }
        summaries.append(
            {
                "way": text,
                **figures,
                "messages": len(ages_ms),
            }
        )
    return pd.DataFrame(summaries)
