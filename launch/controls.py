"""The controls of a running graph: requests of a node that watches it, or of another program
through a socket of the user's own, and news of the graph for both.
"""

from __future__ import annotations

import time
from typing import Any

from .control_socket import ControlServer
from .fleet import Fleet
from .graph_state import graph_description, graph_state
from .launchspec import LaunchFile
from .live_recording import LiveRecording
from .missing import hosts_state
from .process import NodeProcess
from .requests import Requests

NEWS_S = 0.5
"""How often the state of the graph is told at the least; a change is told at once."""


class Controls:
    """Joins those who sit at the controls with the nodes of a graph.

    Parameters
    ----------
    launch : LaunchFile
        The graph.
    fleet : Fleet
        Its nodes.
    path : str or None
        Path of the socket; None: no socket.
    """

    def __init__(self, launch: LaunchFile, fleet: Fleet, path: str | None) -> None:
        self._launch = launch
        self._fleet = fleet
        self._recording = LiveRecording(launch, fleet)
        self._requests = Requests(fleet.nodes, self._recording.command)
        self._server = (
            ControlServer(path, fleet, self._requests.take, self._describe) if path else None
        )
        self._next_s = 0.0
        self._said: list[str] = []
        fleet.hear = self._hear

    def serve(self) -> None:
        """Tell what is new; answer in place of nodes that do not."""
        self._requests.expire()
        if self._server is not None:
            self._server.flush()
        conditions = [self._fleet.condition(node) for node in self._fleet]
        if conditions == self._said and time.monotonic() < self._next_s:
            return
        self._said = conditions
        self._next_s = time.monotonic() + NEWS_S
        watching = [node for node in self._fleet if node.spec.cls.watches and node.ready]
        if not watching and not (self._server and self._server.watched):
            return
        state = graph_state(self._launch.name, self._fleet, self._recording.out)
        state["hosts"] = hosts_state(self._launch, self._fleet)
        for node in watching:
            node.news("graph", state)
        if self._server is not None:
            self._server.tell({"graph": state})

    def close(self) -> None:
        """Take no more requests."""
        if self._server is not None:
            self._server.close()

    def _describe(self, node: str | None) -> dict[str, Any]:
        return graph_description(self._launch.name, self._fleet, self._recording.out, node)

    def _hear(self, node: NodeProcess, event: dict[str, Any]) -> None:
        self._recording.hear(node, event["event"])
        match event["event"]:
            case "request":
                self._requests.take(event, lambda answer: node.command("answer", value=answer))
            case "answer":
                self._requests.answered(event)
                self._next_s = 0.0
