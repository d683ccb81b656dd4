"""Starts a graph's processes, joins them, watches them and ends them all."""

from __future__ import annotations

import selectors
import signal
import time
from collections.abc import Callable, Mapping
from types import FrameType
from typing import Any

from sparseskin.nodes.clock import wall_offset_ns

from .configs import node_config, note_of
from .launchfile import LaunchFile
from .process import NodeProcess, exit_text
from .running import RunningGraph, announced, is_running
from .terminal import Terminal

START_S = 30.0
"""How long all nodes together may take until they are ready."""
DRAIN_S = 5.0
"""How long frames under way may take to the end of the graph, once the sources have stopped."""
GRACE_S = 2.0
"""How long a process may take from one request to end to the next, sterner one."""
POLL_S = 0.1
LOOK_S = 0.5
QUIT_KEYS = ("q", "\x03")

EXIT_FAILED = 1
EXIT_USAGE = 2


class Launcher:
    """Runs one graph from start to end.

    Parameters
    ----------
    launch : LaunchFile
        The checked launch file.
    terminal : Terminal
        Where log lines and the status line go.
    max_frames : int, optional
        Frames after which each source ends its stream.
    joined : RunningGraph, optional
        A graph that already runs, whose topics the nodes of this one read.
    keys : mapping of str to (node, command), optional
        Keys of the terminal, and the commands they are to nodes.
    """

    def __init__(
        self,
        launch: LaunchFile,
        terminal: Terminal,
        max_frames: int | None = None,
        joined: RunningGraph | None = None,
        keys: Mapping[str, tuple[str, str]] | None = None,
    ) -> None:
        self._launch = launch
        self._terminal = terminal
        self._max_frames = max_frames
        self._joined = joined
        self._keys = dict(keys or {})
        self._look_at_s = 0.0
        self._offset_ns = joined.offset_ns if joined else wall_offset_ns()
        self._nodes: dict[str, NodeProcess] = {}
        self._selector = selectors.DefaultSelector()
        writers = {link.writer for link in launch.links}
        self._sinks = [name for name in launch.nodes if name not in writers]
        self._interrupts = 0
        self._gone = False
        self._exit_code = 0
        self._late_code = 0

    def run(self) -> int:
        """Run the graph until its streams end; return the exit code: 0, 1 for a node that
        failed, 2 for one that refused its settings, 128 + the signal for an interrupt.
        """
        old = {
            number: signal.signal(number, self._on_signal)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        }
        try:
            self._spawn()
            if self._handshake():
                endpoints = {name: node.endpoint for name, node in self._nodes.items()}
                note = note_of(self._launch, endpoints, self._offset_ns)
                with announced(note), self._terminal.keyboard(bool(self._keys)):
                    self._command_all("start")
                    self._until(self._all_ended, None)
                    if not self._all_ended():
                        self._drain()
        finally:
            self._end_all()
            for number, handler in old.items():
                signal.signal(number, handler)
            self._terminal.status("")
        return self._exit_code or self._late_code

    def summary(self) -> dict[str, Any]:
        """What the nodes reported, and what each of them counted."""
        merged: dict[str, Any] = {"launch": self._launch.name, "patches": {}, "nodes": {}}
        for name, node in self._nodes.items():
            found = dict(node.report)
            merged["patches"].update(found.pop("patches", {}))
            type_name = self._launch.nodes[name].type_name
            merged["nodes"][name] = {"type": type_name, **node.counts, **found}
        return merged

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        self._interrupts += 1
        self._exit_code = self._exit_code or 128 + number

    def _spawn(self) -> None:
        for name in self._launch.nodes:
            config = node_config(
                self._launch, name, self._offset_ns, self._max_frames, self._joined is not None
            )
            node = NodeProcess(name, config)
            self._nodes[name] = node
            for pipe in node.pipes:
                self._selector.register(pipe, selectors.EVENT_READ, node)

    def _handshake(self) -> bool:
        """Join the nodes; False if one of them failed or was late."""
        if not self._until(lambda: all(n.endpoint for n in self._nodes.values()), START_S):
            return self._name_late("has not started", lambda node: not node.endpoint)
        for name, node in self._nodes.items():
            writers = sorted({k.writer for k in self._launch.links if k.reader == name})
            node.command("connect", endpoints=[self._endpoint_of(w) for w in writers])
        if not self._until(lambda: all(n.ready for n in self._nodes.values()), START_S):
            return self._name_late("is not ready", lambda node: not node.ready)
        self._terminal.log(f"[launch] ready: {', '.join(self._nodes)}")
        return True

    def _endpoint_of(self, writer: str) -> str:
        if self._joined is not None:
            return self._joined.nodes[writer].endpoint
        return self._nodes[writer].endpoint

    def _look_around(self) -> None:
        """Pass on keys, and notice where the graph that was joined is gone."""
        for key in self._terminal.pressed():
            if key in self._keys:
                node, command = self._keys[key]
                self._nodes[node].command(command)
            elif key in QUIT_KEYS:
                self._interrupts += 1
        if self._joined is not None and time.monotonic() >= self._look_at_s:
            self._look_at_s = time.monotonic() + LOOK_S
            if not is_running(self._joined) and not self._gone:
                self._gone = True
                self._interrupts += 1

    def _name_late(self, what: str, is_late: Callable[[NodeProcess], bool]) -> bool:
        if not self._exit_code:
            self._exit_code = EXIT_FAILED
            for node in filter(is_late, self._nodes.values()):
                lack = f": no subscription from {', '.join(node.lacks)}" if node.lacks else ""
                self._terminal.log(f"[launch] {node.name} {what} after {START_S:g} s{lack}")
        return False

    def _all_ended(self) -> bool:
        return all(node.ended or node.failed for node in self._nodes.values())

    def _all_drained(self) -> bool:
        """Whether all have ended but those that wait for a node that is dead."""
        cut_off = {name for name, node in self._nodes.items() if node.exit_code() is not None}
        for _ in self._nodes:
            cut_off |= {link.reader for link in self._launch.links if link.writer in cut_off}
        return all(
            node.ended or node.failed or name in cut_off for name, node in self._nodes.items()
        )

    def _until(
        self, done: Callable[[], bool], limit_s: float | None, draining: bool = False
    ) -> bool:
        """Serve the nodes until something is done; False where the time was over first, or an
        interrupt or a failure came. While draining it takes a second interrupt.
        """
        deadline = None if limit_s is None else time.monotonic() + limit_s
        while not done():
            if self._interrupts > draining or (self._exit_code and not draining):
                return False
            if deadline is not None and time.monotonic() >= deadline:
                return False
            self._serve()
        return True

    def _serve(self) -> None:
        self._look_around()
        ready = self._selector.select(POLL_S)
        for node in {id(key.data): key.data for key, _ in ready}.values():
            self._listen(node)
        for node in self._nodes.values():
            code = node.exit_code()
            if code is not None and not node.ended:
                self._listen(node)
                if not node.ended:
                    node.ended = True
                    text = f"[launch] {node.name} ended too early: {exit_text(code)}"
                    self._fail(node, EXIT_FAILED, text)
        lines = [self._nodes[name].line for name in self._sinks]
        self._terminal.status("  ||  ".join(filter(None, lines)))

    def _listen(self, node: NodeProcess) -> None:
        events, log = node.read()
        for pipe in node.closed_pipes:
            if pipe in self._selector.get_map():
                self._selector.unregister(pipe)
        for line in log:
            self._terminal.log(f"[{node.name}] {line}")
        for event in events:
            match event["event"]:
                case "bound":
                    node.endpoint = event["endpoint"]
                case "ready":
                    node.ready = True
                case "heartbeat":
                    node.lacks, node.line = event["lacks"], event["line"]
                    node.counts = event["counts"]
                case "ended":
                    node.ended = True
                    node.counts, node.report = event["counts"], event["report"]
                case "failed":  # the node has said why in its log
                    self._fail(node, EXIT_USAGE, "")
                case "error":
                    node.ended = True
                    self._fail(node, event["code"], f"[{node.name}] error: {event['text']}")
                case _:
                    self._terminal.log(f"[{node.name}] {event}")

    def _fail(self, node: NodeProcess, code: int, line: str) -> None:
        """A node cannot go on. The graph ends with it, if it is one that it needs."""
        if line:
            self._terminal.log(line)
        if self._launch.nodes[node.name].cls.required:
            self._exit_code = self._exit_code or code
        else:
            node.failed = True
            self._late_code = self._late_code or code

    def _command_all(self, command: str) -> None:
        for node in self._nodes.values():
            node.command(command)

    def _drain(self) -> None:
        """Stop the sources, and let what is under way reach the end of the graph."""
        if self._joined is not None:
            return  # the sources are not ours
        for node in self._nodes.values():
            node.send_signal(signal.SIGINT)
        if not self._until(self._all_drained, DRAIN_S, draining=True):
            late = [node.name for node in self._nodes.values() if not node.ended]
            if late and self._interrupts <= 1:
                self._terminal.log(f"[launch] not drained after {DRAIN_S:g} s: {', '.join(late)}")

    def _end_all(self) -> None:
        """End every process: ask, then SIGTERM, then SIGKILL; say who needed what."""
        self._command_all("stop")
        for node in self._nodes.values():
            if not node.endpoint:  # still starting: it does not listen yet
                node.send_signal(signal.SIGTERM)
        for number in (signal.SIGTERM, signal.SIGKILL):
            deadline = time.monotonic() + GRACE_S
            while self._alive() and time.monotonic() < deadline:
                self._selector.select(POLL_S)
                for node in self._nodes.values():
                    self._listen(node)
            for node in self._alive():
                self._terminal.log(f"[launch] {node.name} does not end: {number.name}")
                node.send_signal(number)
        for node in self._nodes.values():
            self._listen(node)
            node.close()
        self._selector.close()

    def _alive(self) -> list[NodeProcess]:
        return [node for node in self._nodes.values() if node.exit_code() is None]
