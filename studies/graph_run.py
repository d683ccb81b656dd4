"""A graph launched as its user launches it, and observed from outside: processes, files, state."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Self

from sparseskin.launch.run.control_socket import ControlClient

from .points import StudyError

PATIENCE_S = 120.0
"""Time after which a wait fails: far beyond what anything takes that goes well."""
LOOK_S = 0.005
_MARK = "SPARSESKIN_GRAPH_RUN"
_PROGRAM = (sys.executable, "-m", "sparseskin.launch.commands.entry")


class GraphRun:
    """One run of `sparseskin launch`, to be used in a `with`: nothing of it outlives that.

    Parameters
    ----------
    launch : str
        Text of a launch file, or the name of one.
    *arguments : str
        Further arguments of the command.
    folder : Path, optional
        Empty folder in which it runs, and which keeps its output and its files; by default a
        temporary one, which is removed at the end.
    environment : mapping of str to str, optional
        Environment variables that differ from those of this process.

    Raises
    ------
    StudyError
        If the graph does not become ready.
    """

    def __init__(
        self,
        launch: str,
        *arguments: str,
        folder: Path | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._is_temporary = folder is None
        self.folder = (folder or Path(tempfile.mkdtemp(prefix="sparseskin-graph-"))).resolve()
        self.folder.mkdir(parents=True, exist_ok=True)
        if "\n" in launch:
            (self.folder / "graph.toml").write_text(launch)
            launch = "graph.toml"
        self._mark = uuid.uuid4().hex
        self.notes = self.folder / "notes"
        """Folder of this run's notes, so that no other graph on the host is found in its place."""
        self._environment = {
            **os.environ,
            _MARK: self._mark,
            "SPARSESKIN_RUNTIME_DIR": str(self.notes),
            "XDG_STATE_HOME": str(self.folder / "state"),
            **(environment or {}),
        }
        self.environment: dict[str, str] = self._environment
        """Environment of its processes, for one that is to be found among them."""
        self.stack = contextlib.ExitStack()
        """Contexts that end before the graph is killed."""
        out, err = ((self.folder / f"{name}.txt").open("wb") for name in ("stdout", "stderr"))
        with out, err:
            arguments = ("launch", launch, "--summary", "summary.json", *arguments)
            self.process = self.start(*arguments, stdout=out, stderr=err, start_new_session=True)
        self._client: ControlClient | None = None
        self._state: dict[str, Any] = {}
        self._n_requests = 0
        try:
            self.wait_for("[launch] ready")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self, *arguments: str, **options: Any) -> subprocess.Popen[bytes]:
        """Start a command `sparseskin` that sees this graph; `options` are those of `Popen`."""
        command = [*_PROGRAM, *arguments]
        return subprocess.Popen(command, cwd=self.folder, env=self._environment, **options)

    @property
    def log(self) -> list[str]:
        """Lines that launcher and nodes have logged so far, without their times."""
        text = (self.folder / "stderr.txt").read_text(errors="replace")
        return [re.sub(r"^\d\d:\d\d:\d\d\.\d{3} ", "", line) for line in text.splitlines()]

    def wait_for(self, token: str) -> str:
        """Wait until a line of the log holds a token; the last such line."""
        found: list[str] = []

        def has_come() -> bool:
            ended = self.process.poll() is not None
            found[:] = [line for line in self.log if token in line]
            if ended and not found:
                raise StudyError(f"the graph ended without {token!r}: {self.log[-5:]}")
            return bool(found)

        wait_until(has_come, repr(token))
        return found[-1]

    def note(self) -> dict[str, Any]:
        """The launcher's note of the graph, by which other programs find it."""
        found: list[dict[str, Any]] = []

        def is_there() -> bool:
            with contextlib.suppress(ValueError, OSError):
                notes = [json.loads(path.read_text()) for path in self.notes.glob("*.json")]
                found.extend(note for note in notes if note["nodes"])  # none while it starts
            return bool(found)

        wait_until(is_there, "the graph's note")
        return found[0]

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

    def nodes(self) -> dict[str, int]:
        """Process numbers of the nodes that run, by name."""
        return {
            found[1]: pid
            for pid, line in self.processes().items()
            if (found := re.search(r"sparseskin\.nodes\.process\.run_node (\S+)\s*$", line))
        }

    def stopped(self, before: Mapping[str, int], *but: str) -> list[str]:
        """Nodes, except those named, that are gone or run as another process than before."""
        now = self.nodes()
        return [name for name, pid in before.items() if name not in but and now.get(name) != pid]

    def state(self) -> dict[str, dict[str, Any]]:
        """Newest state of each node that the launcher has published, by name."""
        if self._client is None:
            path = self.notes / f"{self.process.pid}.sock"
            wait_until(path.exists, "the control socket")
            self._client = self.stack.enter_context(closing(ControlClient(str(path))))
            self._client.send({"watch": True})
        for fields in self._client.receive() or ():
            if "graph" in fields:
                self._state = {node["name"]: node for node in fields["graph"]["nodes"]}
        return self._state

    def ask(self, node: str, command: str, value: Any) -> None:
        """Send a node a command, as the terminal of the graph does."""
        self.state()
        assert self._client is not None
        self._n_requests += 1
        number = str(self._n_requests)
        self._client.send({"id": number, "node": node, "command": command, "value": value})

    def end(self) -> int:
        """End the graph as Ctrl-C does, wait for it, and return its exit code."""
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGINT)
        return self.wait()

    def wait(self, patience_s: float | None = PATIENCE_S) -> int:
        """Wait for the end of the graph, for ever where `patience_s` is None; the exit code."""
        try:
            return self.process.wait(patience_s)
        except subprocess.TimeoutExpired as error:
            raise StudyError(f"the graph does not end: {self.log[-5:]}") from error

    def summary(self) -> dict[str, Any]:
        """The summary that the graph has written as it ended."""
        found: dict[str, Any] = json.loads((self.folder / "summary.json").read_text())
        return found

    def left_behind(self) -> list[str]:
        """Processes, notes and unfinished files that are there after the end; to be empty."""
        left = [f"process {line.strip()}" for line in self.processes().values()]
        if self.notes.is_dir():
            left += [f"note {path.name}" for path in self.notes.iterdir()]
        for pattern in ("*.part", "core*"):
            left += [f"file {path.name}" for path in self.folder.glob(pattern)]
        return left

    def shared_memory(self) -> list[str]:
        """Files in /dev/shm that processes of the graph have mapped, while it runs."""
        found = []
        for pid in self.processes():
            with contextlib.suppress(OSError):
                text = Path(f"/proc/{pid}/maps").read_text()
                found += [line.split()[-1] for line in text.splitlines() if "/dev/shm/" in line]
        return found

    def close(self) -> None:
        """Kill all processes that are left, and remove a temporary folder."""
        self.stack.close()
        for pid in self.processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()
        if self._is_temporary:
            shutil.rmtree(self.folder, ignore_errors=True)


def launch_text(
    nodes: Mapping[str, Mapping[str, Any]], graph: Mapping[str, Any] | None = None
) -> str:
    """Text of a launch file.

    Parameters
    ----------
    nodes : mapping of str to mapping
        Settings of each node by its name, which is its type where none is stated.
    graph : mapping, optional
        The table [graph]. Here and there, keys whose value is None are left out.
    """
    tables = {f"nodes.{name}": {"type": name, **settings} for name, settings in nodes.items()}
    return "".join(
        f"[{table}]\n"
        + "".join(
            f"{key} = {json.dumps(value)}\n" for key, value in values.items() if value is not None
        )
        for table, values in {"graph": graph or {}, **tables}.items()
    )


def wait_until(done: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> float:
    """Poll a condition until it is true; the seconds that it took.

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
