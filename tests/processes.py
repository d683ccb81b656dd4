"""Runs of the command `sparseskin`: their processes, and waiting for them without guessing."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from sparseskin.launch.run.running import RunningGraph, remove_note, write_note
from sparseskin.nodes.network.sockets import Writer

PATIENCE_S = 300.0
"""When a wait is given up: far beyond what anything here takes, so it is no claim on speed."""


def wait_until(
    done: Callable[[], bool], what: str, patience_s: float = PATIENCE_S
) -> float:
    """Look again and again until something is so; the seconds that it took."""
    began_s = time.monotonic()
    while not done():
        assert time.monotonic() < began_s + patience_s, f"gave up waiting for {what}"
        time.sleep(0.01)
    return time.monotonic() - began_s


def note_of_graph(folder: Path) -> Path:
    """The note of the graph whose runtime folder this is, once the graph can be joined."""
    found: list[Path] = []

    def is_there() -> bool:
        for path in folder.glob("*.json"):
            with contextlib.suppress(ValueError, OSError):  # it is being written
                found.extend([path] if json.loads(path.read_text())["nodes"] else [])
        return bool(found)

    wait_until(is_there, "the note of the graph")
    return found[0]


@contextlib.contextmanager
def announced(graph: RunningGraph) -> Iterator[None]:
    """The note of a graph, and its control socket, where nobody answers."""
    with socket.socket(socket.AF_UNIX) as listener:
        if not os.path.lexists(graph.control):
            listener.bind(graph.control)
            listener.listen()
        write_note(graph)
        yield
        remove_note(graph)
    Path(graph.control).unlink(missing_ok=True)


def processes_with(mark: str) -> dict[int, str]:
    """Command lines of all processes with KEY=VALUE in their environment, by pid."""
    found = {}
    for folder in (path for path in Path("/proc").iterdir() if path.name.isdecimal()):
        with contextlib.suppress(OSError):
            if mark.encode() in (folder / "environ").read_bytes().split(b"\0"):
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ")
                found[int(folder.name)] = command.decode(errors="replace")
    return found


def wait_for_reader(writer: Writer, name: str) -> None:
    """Serve the subscriptions of a writer until a reader is present."""

    def is_present() -> bool:
        writer.serve_subscriptions()
        return name in writer.present

    wait_until(is_present, f"the reader {name}")


LOOP = """\
from functools import partial
from sparseskin.studies.looped import Looped
path_40 = partial(Looped, "path_40", 330, 50, "truth")
"""
"""A module of a source without an end: frames of a scene, touched from frame 320 on."""
SENSOR = """\
[nodes.sensor]
type = "sensor"
source = "scene:path_40"
rate_hz = 20
"""
"""A launch file of a sensor alone, which runs for ten minutes and starts in a fifth of the time."""
COMMAND = ["-m", "sparseskin.launch.commands.entry"]
PATIENT_COMMAND = [str(Path(__file__).with_name("patient.py"))]


class Program:
    """One run of the command `sparseskin`, to be used in a `with`: nothing of it outlives that.

    Its time limits are those of `patient.py`, or with `limits` its own. `environment`: variables
    that differ from those of this process; `options`: of `Popen`. Solvers are those of numpy, which
    start in half the time.
    """

    def __init__(
        self,
        *arguments: str,
        cwd: Path,
        prefix: Sequence[str] = (),
        limits: bool = False,
        environment: Mapping[str, str] | None = None,
        **options: Any,
    ) -> None:
        self._mark = f"SPARSESKIN_TEST={uuid.uuid4().hex}"
        key, value = self._mark.split("=")
        self.cwd, self.notes = cwd, cwd / "graphs"
        # Graphs of a test are told apart from all others on the host.
        self.environment = {
            **os.environ,
            **{
                key: value,
                "SPARSESKIN_RUNTIME_DIR": str(self.notes),
                "SPARSESKIN_FAST": "off",
            },
            "XDG_STATE_HOME": str(cwd / "state"),
            **(environment or {}),
        }
        self._stderr = ""
        self.process = subprocess.Popen(
            [
                *prefix,
                sys.executable,
                *(COMMAND if limits else PATIENT_COMMAND),
                *arguments,
            ],
            **{"cwd": cwd, "env": self.environment, "text": True},
            **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options},
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill_all()
        self.process.communicate()

    def wait_for(self, token: str) -> str:
        """Read stderr until a line holds the token; return what follows it there."""
        for line in self.process.stderr:
            self._stderr += line
            if token in line:
                return line.partition(token)[2].strip()
        raise AssertionError(f"ended without {token!r}: {self._stderr}")

    def finish(self) -> tuple[int, str, str]:
        """Wait for the end; (exit code, stdout, stderr)."""
        stdout, stderr = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, stdout, self._stderr + stderr

    def ended(self, *codes: int) -> tuple[str, str]:
        """Wait for the end, with exit code 0 or one stated, and no traceback; stdout and stderr."""
        code, stdout, stderr = self.finish()
        assert code in (codes or (0,)), stderr
        assert "Traceback" not in stderr
        return stdout, stderr

    def survivors(self) -> dict[int, str]:
        """Command lines of all processes that carry this run's mark, by pid."""
        return processes_with(self._mark)

    def nodes(self) -> dict[str, int]:
        """Process numbers of the nodes that run, by name."""
        return {
            name: pid
            for pid, line in self.survivors().items()
            if (found := re.search(r"sparseskin\.nodes\.process\.run_node (.+)$", line))
            for name in found[1].split()
        }

    def pid_of(self, node: str) -> int:
        """Process number of a node."""
        return self.nodes()[node]

    def kill_all(self) -> None:
        for pid in self.survivors():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


PROGRAM = [sys.executable, "-m", "sparseskin.launch.commands.entry"]


def words(line: str, breaks: str = " \t\n\"'><=;|&(:") -> list[str]:
    """Candidates of the last word of `sparseskin LINE` for bash, with its word breaks."""
    typed = f"sparseskin {line}"
    reader, writer = os.pipe()
    environment = {
        **os.environ,
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_SHELL": "bash",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
        "_ARGCOMPLETE_COMP_WORDBREAKS": breaks,
        "COMP_TYPE": "9",
        "COMP_LINE": typed,
        "COMP_POINT": str(len(typed)),
    }
    # argcomplete writes to file descriptor 8.
    shell = ["bash", "-c", f'exec 8>&{writer}; exec "$@"', "bash", *PROGRAM]
    with os.fdopen(reader) as found:
        subprocess.run(
            shell, env=environment, pass_fds=[writer], check=True, timeout=120
        )
        os.close(writer)
        return found.read().splitlines()
