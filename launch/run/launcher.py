"""Runs a graph from start to end: starts its nodes, joins them, watches them, ends them all."""

import contextlib
import math
import os
import signal
from collections.abc import Callable, Mapping
from types import FrameType

from sparseskin.launch.launchfile.spec import LaunchFile
from sparseskin.nodes.clock import wall_offset_ns
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.process.control import Document

from .controls import Controls
from .fleet import EXIT_FAILED, START_S, Fleet
from .process import awake_s
from .running import (
    GraphError,
    RunningGraph,
    is_running,
    remove_files,
    remove_note,
    write_note,
)
from .state import hosts_state
from .terminal import Terminal
from .termination import TERMINATION
from .waiting import LateLog, late_at_end, waits_for

DRAIN_S = 5.0
"""Longest time for frames under way to reach the end of the graph after its sources, seconds."""
REST_S = 1.0
"""Time for what a graph that was joined and is gone has sent last, seconds."""
LOOK_S = 0.5
"""Time between two checks that a graph that was joined still runs, seconds."""
QUIT_KEYS = ("q", "\x03")


class Launcher:
    """Runs one graph from start to end; each source ends its stream after `max_frames` frames.

    `joined` is a graph that already runs, whose topics the nodes of this one read. `keys` maps keys
    of the terminal to (node, command).
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
        self._joined = joined
        self._keys = dict(keys or {})
        self._look_at_s = 0.0
        # One clock for both graphs: ages are of stamps of the one that is joined.
        offset_ns = wall_offset_ns()
        if joined is not None:
            offset_ns = joined.offset_ns
        self._starting = RunningGraph(launch.name, os.getpid(), offset_ns, "", {})
        self._fleet = Fleet(
            launch, offset_ns, terminal.log, max_frames, joined, terminal.record
        )
        self._controls: Controls | None = None
        self._late = LateLog(self._late_lines, terminal.log, awake_s)
        writers = {link.writer for link in launch.links}
        self._sinks = [name for name in launch.nodes if name not in writers]
        self._interrupts = 0
        self._gone = False
        self._signal_code = 0

    def run(self) -> int:
        """Run the graph until its streams end; return the exit code: 0, 1 for a node that
        failed, 2 for one that refused its settings, 128 + the signal for an interrupt. An interrupt
        is the intended end of nodes that have joined another graph: 0.
        Raises SparseskinError before any node starts if the runtime folder cannot be used, or the
        graph that is joined has ended.
        """
        if self._joined is None:
            self._controls = Controls(self._launch, self._fleet, self._starting.control)
        elif not is_running(self._joined):
            raise GraphError(f"{self._joined.label}: has just ended")
        TERMINATION.check()
        handlers = {}
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            handlers[number] = signal.signal(number, self._on_signal)
        try:
            self._run()
        finally:
            # First the note: nobody is to join a graph that ends.
            with contextlib.suppress(OSError, SparseskinError):
                remove_note(self._starting)
            self._fleet.end_all()
            if self._controls is not None:
                self._controls.close()
            with contextlib.suppress(OSError, SparseskinError):
                remove_files(os.getpid())
            for number, handler in handlers.items():
                signal.signal(number, handler)
            self._terminal.status("")

        for node in self._fleet:
            n_errors = node.counts.get("errors", 0)
            if n_errors:
                self._terminal.log(
                    f"[launch] {node.name} raised {n_errors} errors (see its log)"
                )
        return self._exit_code or self._fleet.late_code

    def _run(self) -> None:
        if self._joined is None:
            write_note(self._starting)
        self._warn_of_exposure()
        self._fleet.spawn()
        if not self._handshake():
            return
        if self._joined is None:
            write_note(self._fleet.note())
        with self._terminal.keyboard(bool(self._keys)):
            # A node that has joined a graph ends with it.
            self._fleet.supervised = self._joined is None
            self._fleet.command_all("start")
            self._until(self._all_ended, None)
            self._fleet.supervised = False
            if not self._all_ended():
                self._drain()

    def _warn_of_exposure(self) -> None:
        """Log who else can read and write the topics of a graph without keys."""
        launch = self._launch
        if launch.security:
            return
        if launch.insecure and launch.hosts:
            self._terminal.log(
                "[launch] warning: insecure = true and no keys: whoever reaches this network "
                "can read all topics and pretend to be any node"
            )
        elif launch.transport == "tcp":
            self._terminal.log(
                "[launch] warning: tcp and no keys: any user of this host can read all topics, "
                "hold up this graph, and pretend to be a node that is started again; keys or ipc "
                "prevent it"
            )

    def summary(self) -> Document:
        """Reports and counts of the nodes."""
        merged: Document = {
            "launch": self._launch.name,
            "patches": {},
            "nodes": {},
        }
        if self._launch.host:
            merged["host"] = self._launch.host
            merged["hosts"] = hosts_state(self._launch, self._fleet)
        restarts = self._fleet.restarts
        any_restarted = any(of_node.total for of_node in restarts.values())
        counts = [node.counts for node in self._fleet]
        for node in self._fleet:
            report = dict(node.report)
            unfinished = self._fleet.left.get(node.name)
            if unfinished:
                report["lines"] = [*report.get("lines", ()), *unfinished]
            # The report of a node is of its last run alone, and lacks what others lost.
            if any_restarted:
                spec = node.spec
                again = restarts[node.name].total > 0
                report |= spec.cls.totals(spec.settings, report, counts, again)
            merged["patches"].update(report.pop("patches", {}))
            merged["nodes"][node.name] = {
                **report,
                "type": node.spec.type_name,
                "restarts": restarts[node.name].total,
                "failures": list(restarts[node.name].failures),
                **node.counts,
            }
        return merged

    @property
    def _exit_code(self) -> int:
        return self._signal_code or self._fleet.exit_code

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        self._interrupts += 1
        if self._joined is None and not self._fleet.exit_code:
            self._signal_code = self._signal_code or 128 + number

    def _handshake(self) -> bool:
        """Join the nodes; False if one of them failed or was late."""
        fleet = self._fleet
        # Parts start in any order: however long another host takes, it is waited for.
        limit_s: float | None = START_S
        if self._launch.elsewhere:
            limit_s = None
        done = self._until(lambda: all(node.endpoint for node in fleet), START_S)
        if done:
            for node in fleet:
                fleet.connect(node)
            done = self._until(lambda: all(node.ready for node in fleet), limit_s)
        if done:
            ready = "ready"
            if self._launch.host:
                ready += f" on {self._launch.host}"
            self._terminal.log(f"[launch] {ready}: {', '.join(fleet.nodes)}")
        elif not self._exit_code and not self._interrupts:
            fleet.exit_code = EXIT_FAILED
            for line in self._late_lines():
                self._terminal.log(f"[launch] after {START_S:g} s: {line}")
        return done

    def _late_lines(self) -> list[str]:
        # The others wait for those that have not started.
        nodes = [node for node in self._fleet if not (node.endpoint or node.failed)]
        lines = [waits_for(node, self._launch) for node in nodes or self._fleet]
        return [line for line in lines if line]

    def _look_around(self) -> None:
        """Pass on keys, and end where the graph that was joined is gone."""
        for key in self._terminal.pressed():
            if key in self._keys:
                node, command = self._keys[key]
                self._fleet.nodes[node].command(command)
            elif key in QUIT_KEYS:
                self._interrupts += 1
        if self._joined is not None and awake_s() >= self._look_at_s:
            self._look_at_s = awake_s() + LOOK_S
            if not is_running(self._joined) and not self._gone:
                self._gone = True
                self._interrupts += 1

    def _all_ended(self) -> bool:
        return all(node.ended or node.failed for node in self._fleet)

    def _all_drained(self) -> bool:
        """True if all have ended but those that wait for a node that is dead."""
        dead = {node.name for node in self._fleet if node.exit_code() is not None}
        # The sources of another host are not stopped from here.
        endless = self._launch.elsewhere.keys()
        links = self._launch.links
        cut_off = dead | {link.reader for link in links if link.writer in endless}
        # Along the links: no path is longer than the number of nodes.
        for _ in self._fleet:
            cut_off |= {link.reader for link in links if link.writer in cut_off}
        waited_for = [node for node in self._fleet if node.name not in cut_off]
        return all(node.ended or node.failed for node in waited_for)

    def _until(
        self, done: Callable[[], bool], limit_s: float | None, draining: bool = False
    ) -> bool:
        """Serve until `done`; False if time, an interrupt (draining: two) or a failure ends it."""
        deadline_s = math.inf
        if limit_s is not None:
            deadline_s = awake_s() + limit_s
        while not done():
            # The first interrupt has begun the drain; one more ends it.
            if self._interrupts > draining:
                return False
            if self._exit_code and not draining:
                return False
            if awake_s() >= deadline_s:
                return False
            self._serve()
            if not draining:
                self._late.look()
        return True

    def _serve(self) -> None:
        self._look_around()
        self._fleet.serve()
        if self._controls is not None:
            self._controls.serve()
        nodes = self._fleet.nodes
        lines = [nodes[name].line for name in self._sinks if name in nodes]
        self._terminal.status("\n".join(filter(None, lines)))

    def _drain(self) -> None:
        """Stop the sources, and let frames under way reach the end of the graph."""
        # The sources of a graph that was joined are not stopped from here.
        if self._joined is not None:
            if self._gone and not self._until(self._all_ended, REST_S, draining=True):
                self._terminal.log(
                    f"[launch] {self._joined.label} was gone before its streams had ended: "
                    "its last messages may be missing"
                )
            return
        for node in self._fleet:
            # One that is still starting has no handler yet; it has nothing to drain either.
            number = signal.SIGTERM
            if node.endpoint:
                number = signal.SIGINT
            node.send_signal(number)
        if not self._until(self._all_drained, DRAIN_S, draining=True):
            late = late_at_end(self._fleet, self._launch.links)
            if late and self._interrupts <= 1:
                self._terminal.log(
                    f"[launch] not drained after {DRAIN_S:g} s: {', '.join(late)}"
                )
