"""Commands in a loop that list the running graphs, while graphs start, end and are killed.

One graph runs all the while. Beside it `node list` and `graph list` run in a loop, and others start
short graphs, which end by themselves, by Ctrl-C, by `sparseskin stop`, or are killed, at any moment
of their life. Files of others lie in the runtime folder.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import signal
import subprocess
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from processes import wait_until
from stress.graphs import PATIENCE_S, GraphRun, launch_text

STEADY_HZ = 20.0
SHORT_HZ = 100.0
SHORT_FRAMES = 50
N_STARTERS = 2
LONGEST_S = 4.0
"""Longest time from the start of a graph to its Ctrl-C or kill, at any moment of its life."""
ENDS = ("by itself", "Ctrl-C", "stop", "kill -9 of the launcher", "kill -9 of all")
FOREIGN = {"settings.json": '{"colour": 1}', "other-7.json": '{"pid": 8}', "7.sock": "no socket"}
"""Files of others in the runtime folder, which have to stay."""
_ENDED = ("no such graph runs", "no graph runs on this host", "has ended")
"""Answers to a `stop` that comes before the graph can be joined, or as it ends."""
_INTERRUPTED = 128 + signal.SIGINT
_MAX_RUNS = 20


def measure(seconds: float, seed: int) -> dict[str, Any]:
    """List, start, end and kill for some seconds: how many commands listed, graphs by how they
    ended and those that were ready before, frames of the steady graph, one line for each thing that
    was not as it has to be, and what is left behind after the end of all.
    """
    nodes: dict[str, dict[str, Any]] = {
        "sensor": {"source": "sparseskin.studies.looped:path_40", "rate_hz": STEADY_HZ},
        **{"compressor": {}, "reconstructor": {}, "monitor": {"port": 0}},
    }
    with GraphRun(launch_text(nodes)) as graph:
        loop = _Loop(graph, seconds)
        with ThreadPoolExecutor() as threads:
            running = [threads.submit(loop.list_again_and_again)]
            for number in range(N_STARTERS):
                generator = random.Random(f"{seed} {number}")
                running.append(threads.submit(loop.start_again_and_again, number, generator))
            for one in running:
                one.result()
        return {
            "lists": loop.n_lists,
            "graphs": dict(sorted(loop.graphs.items())),
            "ready": loop.n_ready,
            "frames": loop.end(),
            "faults": loop.faults,
            "left": loop.left(),
        }


class _Loop:
    """The loops of the study, each for a thread of its own."""

    def __init__(self, graph: GraphRun, seconds: float) -> None:
        self._graph = graph
        self._ends_s = time.monotonic() + seconds
        self._pid = graph.process.pid
        note = graph.note()
        self._label = f"{note['name']}-{self._pid}"
        wait_until((graph.notes / f"{self._pid}.sock").exists, "the control socket")
        self._own = {path.name for path in graph.notes.iterdir()}
        for name, text in FOREIGN.items():
            (graph.notes / name).write_text(text)
        self.faults: list[str] = []
        self.n_lists = 0
        self.n_ready = 0
        self.graphs: Counter[str] = Counter()

    @property
    def _goes_on(self) -> bool:
        return time.monotonic() < self._ends_s

    def list_again_and_again(self) -> None:
        """List nodes and graphs until the time is over: the steady graph is always among them."""
        while self._goes_on:
            for words, expected in (
                (("node", "list", "--graph", str(self._pid)), "reconstructor"),
                (("graph", "list"), str(self._pid)),
            ):
                code, out, err = self._run(*words)
                self.n_lists += 1
                if code != 0 or err or expected not in out.split():
                    self.faults.append(
                        f"{' '.join(words)}: exit code {code}: {(err or out)[-300:]}"
                    )
            self._check_files("after a list")

    def _run(self, *words: str) -> tuple[int, str, str]:
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        process = self._graph.start(*words, **pipes)
        try:
            out, err = process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            out, err = process.communicate()
        return process.returncode, str(out), str(err)

    def _check_files(self, when: str) -> None:
        notes = self._graph.notes
        gone = sorted((self._own | FOREIGN.keys()) - {path.name for path in notes.iterdir()})
        if gone:
            self.faults.append(f"{when}: removed from the runtime folder: {', '.join(gone)}")

    def start_again_and_again(self, number: int, generator: random.Random) -> None:
        """Start graphs until the time is over, and end each in one of the ways."""
        k = 0
        while self._goes_on:
            k += 1
            how = generator.choice(ENDS)
            delay_s = generator.uniform(0.0, LONGEST_S)
            try:
                self._start_one(f"{number}-{k}", how, delay_s)
            except Exception as error:
                self.faults.append(f"graph {number}-{k} ({how}): {error!r}")
            self.graphs[how] += 1
            self._check_files(f"after the end of a graph: {how}")

    def _start_one(self, name: str, how: str, delay_s: float) -> None:
        folder = self._graph.folder
        summary, log = folder / f"{name}.json", folder / f"{name}.txt"
        settings = ("monitor.port=0", f"sensor.rate_hz={SHORT_HZ}")
        words = [word for one in settings for word in ("--set", one)]
        with log.open("wb") as err:
            process = self._graph.start(
                *("launch", "path_40", "--frames", str(SHORT_FRAMES), "--summary", str(summary)),
                *words,
                stdout=subprocess.DEVNULL,
                stderr=err,
                start_new_session=True,
            )
        try:
            if how == "stop":
                self._stop(process)
            elif how != "by itself":
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(delay_s)
                children = _children(process.pid) if how == "kill -9 of all" else []
                process.send_signal(signal.SIGINT if how == "Ctrl-C" else signal.SIGKILL)
                for pid in children:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
            code = process.wait(PATIENCE_S)
        finally:
            process.kill()
            process.wait()
        text = log.read_text(errors="replace")
        self.n_ready += "[launch] ready" in text
        self._judge(name, how, code, text, summary)
        for path in (summary, log):
            path.unlink(missing_ok=True)

    def _stop(self, process: subprocess.Popen[bytes]) -> None:
        """Stop a graph as soon as a command finds it; it may have ended by then."""
        while process.poll() is None:
            code, _, err = self._run("stop", str(process.pid))
            if code == 0 or not any(words in err for words in _ENDED):
                break
        if process.poll() is None and code != 0:
            self.faults.append(f"stop: exit code {code}: {err[-300:]}")
            process.send_signal(signal.SIGINT)

    def _judge(self, name: str, how: str, code: int, text: str, summary: Path) -> None:
        """Note what is not as it has to be about a graph that has ended."""
        killed = how.startswith("kill") and code == -signal.SIGKILL
        if how == "Ctrl-C" and _has_not_begun(text):
            return
        allowed = {0} if how == "by itself" else {0, _INTERRUPTED}
        if how == "Ctrl-C":
            allowed |= {-signal.SIGINT}  # before the command has begun to handle it
        if not killed and code not in allowed:
            self.faults.append(f"graph {name} ({how}): exit code {code}: {text[-600:]}")
        if "Traceback" in text and code != -signal.SIGINT:
            self.faults.append(f"graph {name} ({how}): traceback: {text[-600:]}")
        if not killed and summary.exists():
            for patch in json.loads(summary.read_text())["patches"].values():
                frames = patch["frames"]
                if frames["lost"] or (code == 0 and frames["reconstructed"] != SHORT_FRAMES):
                    self.faults.append(f"graph {name} ({how}): exit code {code}: {frames}")

    def end(self) -> dict[str, int]:
        """End the steady graph; the frames that it has sensed, reconstructed and lost."""
        code = self._graph.end()
        if code != _INTERRUPTED:
            self.faults.append(f"the steady graph: exit code {code}: {self._graph.log[-3:]}")
        summary = self._graph.summary()
        frames: dict[str, int] = summary["patches"]["skin"]["frames"]
        restarts = sum(node["restarts"] for node in summary["nodes"].values())
        if frames["lost"] or restarts:
            self.faults.append(f"the steady graph: {frames}, {restarts} restarts")
        return frames

    def left(self) -> list[str]:
        """What is left behind once one more command has looked: it is to be empty."""
        # A node that was starting as its launcher was killed notices that once it has started.
        wait_until(lambda: not self._graph.processes(), "the end of all nodes")
        code, out, err = self._run("graph", "list")
        if (code, out.strip(), err) != (0, "no graph runs on this host", ""):
            self.faults.append(f"graph list, after the end of all: {code}: {out}{err}")
        for name, text in FOREIGN.items():
            path = self._graph.notes / name
            if not path.exists() or path.read_text() != text:
                self.faults.append(f"{name} of the runtime folder was changed or removed")
            path.unlink(missing_ok=True)
        logs = list((self._graph.folder / "state/sparseskin/log").iterdir())
        # A folder that is made while another start clears them is left for the next start.
        if len(logs) > _MAX_RUNS + N_STARTERS:
            self.faults.append(f"{len(logs)} folders of logs")
        return self._graph.left_behind()


def _has_not_begun(text: str) -> bool:
    """True if a traceback shows nothing of the command itself: Python was starting."""
    own = re.search(r'^\[launch\]|entry\.py", line \d+, in main', text, re.MULTILINE)
    return "Traceback" in text and own is None


def _children(pid: int) -> list[int]:
    """Process numbers of the nodes of a launcher."""
    with contextlib.suppress(OSError):
        tasks = Path(f"/proc/{pid}/task").iterdir()
        return [int(child) for task in tasks for child in (task / "children").read_text().split()]
    return []
