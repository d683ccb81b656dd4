"""A graph that runs as its user runs it, watched from beside it: its processes, files, state."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from sparseskin.launch.control_socket import ControlClient

from .points import StudyError

PATIENCE_S = 120.0
"""When a wait is given up: far beyond what anything takes that goes well."""
LOOK_S = 0.005
_MARK = "SPARSESKIN_GRAPH_RUN"


class GraphRun:
    """One run of `sparseskin launch`, to be used in a `with`: nothing of it outlives that.

    Parameters
    ----------
    folder : Path
        Empty folder in which it runs, and into which all goes that it says.
    graph : str
        Text of the launch file.
    arguments : str
        Further arguments of the command.
    environment : mapping of str to str, optional
        Variables of the environment that differ from this process's.

    Raises
    ------
    StudyError
        If the graph does not become ready.
    """

    def __init__(
        self,
        folder: Path,
        graph: str,
        *arguments: str,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "graph.toml").write_text(graph)
        self._mark = uuid.uuid4().hex
        # Graphs of a study are told apart from all others on the host.
        self.notes = folder / "notes"
        own = {_MARK: self._mark, "SPARSESKIN_RUNTIME_DIR": str(self.notes.resolve())}
        own["XDG_STATE_HOME"] = str((folder / "state").resolve())
        self._environment = {**os.environ, **own, **(environment or {})}
        with (folder / "stderr.txt").open("wb") as err, (folder / "stdout.txt").open("wb") as out:
            self.process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "sparseskin.launch.entry", "launch", "graph.toml"),
                    *("--summary", "summary.json", *arguments),
                ],
                cwd=folder,
                env=self._environment,
                stdout=out,
                stderr=err,
                start_new_session=True,
            )
        self._client: ControlClient | None = None
        self._state: dict[str, Any] = {}
        self._n_asked = 0
        try:
            self.wait_for("[launch] ready")
        except StudyError:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        _type: type[BaseException] | None,
        _error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def said(self) -> list[str]:
        """The lines that launcher and nodes have said so far, without their times."""
        text = (self.folder / "stderr.txt").read_text(errors="replace")
        return [re.sub(r"^\d\d:\d\d:\d\d\.\d{3} ", "", line) for line in text.splitlines()]

    def wait_for(self, token: str, n_times: int = 1) -> str:
        """Wait until so many lines hold a token; the last of them."""
        found: list[str] = []

        def has_come() -> bool:
            found[:] = [line for line in self.said if token in line]
            if len(found) < n_times and self.process.poll() is not None:
                raise StudyError(f"the graph ended without {token!r}: {self.said[-5:]}")
            return len(found) >= n_times

        wait_until(has_come, repr(token))
        return found[-1]

    def note(self) -> dict[str, Any]:
        """What the launcher notes of the graph for others to find."""
        found: list[dict[str, Any]] = []

        def is_there() -> bool:
            with contextlib.suppress(ValueError, OSError):
                found.extend(json.loads(p.read_text()) for p in self.notes.glob("*.json"))
            return bool(found)

        wait_until(is_there, "the graph's note")
        return found[0]

    def nodes(self) -> dict[str, int]:
        """Process numbers of the nodes that are there, by name."""
        return {
            found[1]: pid
            for pid, line in self.processes().items()
            if (found := re.search(r"sparseskin\.nodes\.run_node (\S+)\s*$", line))
        }

    def stopped(self, before: Mapping[str, int], *but: str) -> list[str]:
        """Nodes that are gone, or run as another process than before; some may not count."""
        now = self.nodes()
        return [name for name, pid in before.items() if name not in but and now.get(name) != pid]

    def processes(self) -> dict[int, str]:
        """Command lines of all processes of this run, by process number."""
        mark, found = f"{_MARK}={self._mark}".encode(), {}
        for folder in Path("/proc").iterdir():
            if folder.name.isdecimal():
                with contextlib.suppress(OSError):
                    if mark in (folder / "environ").read_bytes().split(b"\0"):
                        line = (folder / "cmdline").read_bytes().replace(b"\0", b" ")
                        found[int(folder.name)] = line.decode(errors="replace")
        return found

    def command(self, *arguments: str) -> int:
        """Run a command `sparseskin` beside the graph, or after it; its exit code."""
        command = [sys.executable, "-m", "sparseskin.launch.entry", *arguments]
        done = subprocess.run(
            command, cwd=self.folder, env=self._environment, capture_output=True, check=False
        )
        return done.returncode

    def state(self) -> dict[str, dict[str, Any]]:
        """The newest state of each node that the launcher has told, by name."""
        if self._client is None:
            path = self.notes / f"{self.process.pid}.sock"
            wait_until(path.exists, "the control socket")
            self._client = ControlClient(str(path))
            self._client.send({"watch": True})
        for fields in self._client.receive() or ():
            if "graph" in fields:
                self._state = {node["name"]: node for node in fields["graph"]["nodes"]}
        return self._state

    def ask(self, node: str, command: str, value: Any) -> None:
        """Ask something of a node, as whoever sits at the controls."""
        self.state()
        assert self._client is not None
        self._n_asked += 1
        number = str(self._n_asked)
        self._client.send({"id": number, "node": node, "command": command, "value": value})

    def end(self) -> int:
        """End the graph as Ctrl-C does, wait for it, and return its exit code."""
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGINT)
        return self.wait()

    def wait(self) -> int:
        """Wait for the end; the exit code."""
        try:
            return self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired as error:
            raise StudyError(f"the graph does not end: {self.said[-5:]}") from error

    def summary(self) -> dict[str, Any]:
        """The summary that the graph has left."""
        found: dict[str, Any] = json.loads((self.folder / "summary.json").read_text())
        return found

    def left(self) -> list[str]:
        """What is left of the graph once it has ended: processes, notes, unfinished files, files
        in shared memory; to be empty.
        """
        left = [f"process {line.strip()}" for line in self.processes().values()]
        if self.notes.is_dir():
            left += [f"note {path.name}" for path in self.notes.iterdir()]
        left += [f"file {path.name}" for path in self.folder.glob("*.part")]
        left += [f"file {path.name}" for path in self.folder.glob("core*")]
        return left

    def shared_memory(self) -> list[str]:
        """Files in /dev/shm that a process of the graph holds: to be looked at while it runs."""
        found = []
        for pid in self.processes():
            with contextlib.suppress(OSError):
                text = Path(f"/proc/{pid}/maps").read_text()
                found += [line.split()[-1] for line in text.splitlines() if "/dev/shm/" in line]
        return found

    def close(self) -> None:
        """Kill what is left."""
        if self._client is not None:
            self._client.close()
            self._client = None
        for pid in self.processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()


def wait_until(done: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> float:
    """Look again and again until something is so; the seconds that it took.

    Raises
    ------
    StudyError
        If it takes longer than `patience_s`.
    """
    began_s = time.monotonic()
    while not done():
        if time.monotonic() > began_s + patience_s:
            raise StudyError(f"gave up waiting for {what}")
        time.sleep(LOOK_S)
    return time.monotonic() - began_s
