"""One node process as the launcher sees it: its pipes, its state, its end."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from typing import IO, Any

from sparseskin.launch.launchfile.spec import NodeSpec

NEW_S = 8.0
"""Time that a log line is published as the latest one, seconds."""
SILENT_S = 1.6
"""Silence of three heartbeats, after which a node counts as not answering, seconds."""


class NodeProcess:
    """A node in a process of its own, in a session of its own, so that a Ctrl-C in the terminal
    reaches the launcher alone. `config` is what `sparseskin.nodes.process.run_node` expects.
    """

    def __init__(self, spec: NodeSpec, config: dict[str, Any]) -> None:
        self.spec = spec
        self.name = name = spec.name
        self.config = config
        environment = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", **os.environ}
        # -P: a file of the user's that is named like a standard module must not shadow it.
        # The name at the end is for whoever lists processes.
        self._popen = subprocess.Popen(
            [sys.executable, "-P", "-m", "sparseskin.nodes.process.run_node", name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            env=environment,
        )
        self.endpoint = ""
        self.ready = self.ended = self.failed = False
        self.lacks: list[str] = []
        self.heard: dict[str, bool] = {}
        self.clocks: dict[str, tuple[int, int]] = {}
        self.line = self.refusal = ""
        self.state: dict[str, Any] = {}
        self.settings: dict[str, Any] = spec.settings.live_values()
        self.heard_s = time.monotonic()
        self.counts: dict[str, Any] = {}
        self.report: dict[str, Any] = {}
        self.closed_pipes: list[IO[bytes]] = []
        self._rest: dict[int, bytes] = {}
        self._unsent = b""
        self._said, self._said_s = "", 0.0
        assert self._popen.stdin is not None
        for pipe in (*self.pipes, self._popen.stdin):
            os.set_blocking(pipe.fileno(), False)
        self._write(config)

    @property
    def pipes(self) -> tuple[IO[bytes], IO[bytes]]:
        """Events and log lines, to be waited on."""
        assert self._popen.stdout is not None
        assert self._popen.stderr is not None
        return self._popen.stdout, self._popen.stderr

    @property
    def pid(self) -> int:
        return self._popen.pid

    @property
    def condition(self) -> str:
        """Condition of the node, in a word or two."""
        if self.failed or (self.exit_code() is not None and not self.ended):
            return "failed"
        if self.ended:
            return "ended"
        if not self.ready:
            return "starting"
        if time.monotonic() - self.heard_s > SILENT_S:
            return "not answering"
        return "paused" if self.state.get("paused") else "running"

    @property
    def said(self) -> str:
        """The last line of its log, while it is new."""
        return self._said if time.monotonic() - self._said_s < NEW_S else ""

    def exit_code(self) -> int | None:
        """Exit code, negative for a signal; None while the process runs."""
        return self._popen.poll()

    def command(self, command: str, **fields: Any) -> None:
        """Send a command; a process that is gone is noticed by its exit code."""
        self._write({"command": command, **fields})

    def news(self, command: str, value: Any) -> None:
        """Send a value that a newer one will replace: not while older commands are queued."""
        self.flush()
        if not self._unsent:
            self.command(command, value=value)

    def flush(self) -> None:
        """Send what is queued; a process that hangs must not hold up the others."""
        assert self._popen.stdin is not None
        try:
            while self._unsent:
                n_sent = os.write(self._popen.stdin.fileno(), self._unsent)
                self._unsent = self._unsent[n_sent:]
        except BlockingIOError:
            pass
        except OSError:
            self._unsent = b""  # it is gone

    def send_signal(self, number: signal.Signals) -> None:
        if self.exit_code() is None:
            self._popen.send_signal(number)

    def read(self) -> tuple[list[dict[str, Any]], list[str]]:
        """All (events, log lines) that wait."""
        self.flush()
        events, log = (self._lines(pipe) for pipe in self.pipes)
        if log:
            self._said, self._said_s = log[-1], time.monotonic()
        if events:
            self.heard_s = time.monotonic()
        return [_event(line) for line in events], log

    def close(self) -> None:
        """Collect the process and close its pipes; what has not ended by now is killed."""
        with contextlib.suppress(OSError):
            assert self._popen.stdin is not None
            self._popen.stdin.close()
        self.send_signal(signal.SIGKILL)
        self._popen.wait()
        for pipe in self.pipes:
            pipe.close()

    def _lines(self, pipe: IO[bytes]) -> list[str]:
        fd = pipe.fileno()
        data = self._rest.get(fd, b"")
        try:
            while chunk := os.read(fd, 65536):
                data += chunk
            if pipe not in self.closed_pipes:
                self.closed_pipes.append(pipe)
        except BlockingIOError:
            pass
        *lines, self._rest[fd] = data.split(b"\n")
        return [line.decode(errors="replace") for line in lines if line]

    def _write(self, fields: dict[str, Any]) -> None:
        self._unsent += json.dumps(fields).encode() + b"\n"
        self.flush()


def _event(line: str) -> dict[str, Any]:
    try:
        event = json.loads(line)
    except json.JSONDecodeError:
        event = None
    return event if isinstance(event, dict) else {"event": "garbage", "text": line[:200]}


def exit_text(code: int) -> str:
    """Meaning of an exit code, for a person."""
    if code < 0:
        return f"killed by {signal.Signals(-code).name}"
    return f"exit code {code}"
