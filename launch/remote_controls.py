"""The controls of a graph that was joined: they are that graph's own, reached by its socket."""

from __future__ import annotations

from typing import Any

from .control_socket import ControlClient
from .fleet import Fleet
from .process import NodeProcess


class RemoteControls:
    """Passes requests of the nodes here on to the graph that was joined, and its news back.

    Parameters
    ----------
    fleet : Fleet
        The nodes here.
    path : str
        Path of the joined graph's control socket.

    Raises
    ------
    SparseskinError
        If nobody listens there.
    """

    def __init__(self, fleet: Fleet, path: str) -> None:
        self._fleet = fleet
        self._client: ControlClient | None = ControlClient(path)
        self._askers: dict[str, NodeProcess] = {}
        self._client.send({"watch": True})
        fleet.watch(self._client.fd, self._listen)
        fleet.hear = self._hear

    def serve(self) -> None:
        """Send what the graph had no room for."""
        if self._client is not None:
            self._client.flush()

    def close(self) -> None:
        """Leave the graph."""
        if self._client is not None:
            self._fleet.unwatch(self._client.fd)
            self._client.close()
            self._client = None

    def _listen(self) -> None:
        assert self._client is not None
        news = self._client.receive()
        if news is None:
            self.close()
            return
        for fields in news:
            if "graph" in fields:
                for node in self._fleet:
                    if node.spec.cls.watches and node.ready:
                        node.news("graph", fields["graph"])
            elif "answer" in fields:
                asker = self._askers.pop(fields["answer"]["id"], None)
                if asker is not None:
                    asker.command("answer", value=fields["answer"])

    def _hear(self, node: NodeProcess, event: dict[str, Any]) -> None:
        if event["event"] != "request":
            return
        request = {key: event.get(key) for key in ("id", "node", "command", "value")}
        if self._client is None or not self._client.send(request):
            gone = {"id": request["id"], "node": request["node"], "done": False}
            node.command("answer", value={**gone, "text": "the graph is gone"})
            return
        self._askers[str(request["id"])] = node
