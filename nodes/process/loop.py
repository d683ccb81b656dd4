"""The loop of a process, which serves one node, or several one after another."""

import gc
import os
import select
import signal
import sys
import time
from typing import Any, TextIO

import zmq

from sparseskin.nodes.network.sockets import FAREWELL_MS, make_context

from .control import Control
from .runner import Runner

POLL_MS = 100
"""Longest wait, so that signals are noticed."""
SLEEP_NS = 1_500_000
"""Last part of a wait for a tick, which is a sleep: the poller counts whole milliseconds."""
SLEEP_ALONE_NS = 20_000_000
"""The same in a process that reads no node: a sleep alone costs half of a poll and a sleep, and
commands and new readers, which alone come there, can wait for so long. Chosen."""


def waiting_ms(left_ns: int, sleep_ns: int) -> int:
    """Time for which the poller may wait, ms, if a tick is due in `left_ns` and the last part of
    the wait, `sleep_ns` or up to 1 ms more, is to be a sleep. 0: all of it is, since a poller that
    does not wait would be called again and again until then.
    """
    return max(0, (left_ns - sleep_ns) // 1_000_000)


class Loop:
    """Serves the nodes of this process in the order in which the launcher names them.

    What a node publishes is there in the same pass for those after it, so that a frame goes from a
    source to the last node before the next one. `control` is the channel of the node that is
    served now: what is raised is an error of that node.
    """

    def __init__(self, control: Control) -> None:
        self.control = control
        self._runners: list[Runner] = []
        self._served: Runner | None = None
        self._looked_ns = 0  # when the poller was asked last
        self._poller = zmq.Poller()

    def run(self) -> None:
        """Serve the nodes until the launcher sends "stop" to all, or ends.

        Raises SparseskinError if a node refuses its settings, ZMQError if an endpoint is in use.
        """
        channels = self._channels()
        for control, config, log in channels:
            self.control = control
            # Prints of a driver go to the log of its node, line by line.
            sys.stdout = sys.stderr = log
            self._runners.append(Runner(control, config, log))
        if not self._runners:
            return
        context = self._open_sockets()
        signal.signal(signal.SIGINT, self._on_interrupt)
        signal.signal(signal.SIGTERM, self._on_terminate)
        for runner in self._runners:
            self._turn_to(runner)
            runner.start()
        # Modules and compiled loops are half a million objects, which no collection need visit.
        gc.freeze()
        gc.enable()

        while not all(runner.over for runner in self._runners):
            ready = self._wait()
            for runner in self._runners:
                self._turn_to(runner)
                runner.serve(ready)
        for runner in self._runners:
            self._turn_to(runner)
            runner.finish()
        # Pending messages are still sent, for a bounded time.
        context.destroy(linger=FAREWELL_MS)

    def _channels(self) -> list[tuple[Control, dict[str, Any], TextIO]]:
        """Channel, configuration and log of each node; none if the launcher has ended."""
        config = self._configuration()
        if config is None:
            return []
        channels = [(self.control, config, sys.stderr)]
        for fd, log_fd in config.get("channels", ()):
            self.control = Control(fd)
            config = self._configuration()
            if config is None:
                return []
            log = os.fdopen(log_fd, "w", buffering=1)
            channels.append((self.control, config, log))
        return channels

    def _configuration(self) -> dict[str, Any] | None:
        """The first line of a channel; None if the launcher has ended."""
        while True:
            commands = self.control.commands()
            if commands:
                return commands[0]
            if self.control.closed:
                return None
            select.select([self.control.connection], [], [], POLL_MS / 1000)

    def _open_sockets(self) -> zmq.Context[zmq.Socket[bytes]]:
        """Open the sockets of all nodes, in one context; they are scheduled alike."""
        first, *others = self._runners
        # Nodes have been made before: no solver is compiled with real-time priority.
        with first.scheduling.applied():
            context = make_context()
            # Above the nodes: what comes and goes never waits for their work.
            if first.scheduling.priority:
                context.set(zmq.THREAD_PRIORITY, first.scheduling.priority + 1)
            self._turn_to(first)
            first.open(context, self._poller)
        for runner in others:
            self._turn_to(runner)
            runner.open(context, self._poller, first)
        return context

    def _turn_to(self, runner: Runner) -> None:
        if runner is self._served:
            return
        self._served = runner
        self.control = runner.control
        sys.stdout = sys.stderr = runner.log_file

    def _on_interrupt(self, *_: object) -> None:
        for runner in self._runners:
            runner.draining = True

    def _on_terminate(self, *_: object) -> None:
        for runner in self._runners:
            runner.terminate()

    def _wait(self) -> dict[Any, int]:
        """Wait for an event, a signal or the next tick; return sockets and files that are ready."""
        caught_up = True
        reads = False
        left_ns = POLL_MS * 1_000_000
        for runner in self._runners:
            self._turn_to(runner)
            caught_up = caught_up and runner.caught_up
            reads = reads or runner.reader is not None
            of_node_ns = runner.left_ns()
            if of_node_ns is not None:
                left_ns = min(left_ns, of_node_ns)

        now_ns = time.monotonic_ns()
        looked_lately = now_ns < self._looked_ns + SLEEP_ALONE_NS
        if not reads and looked_lately and 0 < left_ns < SLEEP_ALONE_NS:
            time.sleep(left_ns / 1e9)
            return {}

        timeout_ms = waiting_ms(left_ns, SLEEP_NS if reads else SLEEP_ALONE_NS)
        if not caught_up:
            timeout_ms = 0
        ready: dict[Any, int] = dict(self._poller.poll(timeout_ms))
        self._looked_ns = now_ns
        # The rest of the wait is a sleep.
        if timeout_ms == 0 and caught_up and left_ns > 0 and not ready:
            time.sleep(left_ns / 1e9)
            return ready

        # Messages of a frame are read together; but no node waits for the frames of another.
        patience_s = min(runner.patience_s for runner in self._runners)
        if patience_s and caught_up and ready:
            time.sleep(patience_s)
        return ready
