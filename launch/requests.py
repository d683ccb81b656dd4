"""Requests to the nodes of a running graph, and the answers on their way back."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sparseskin.nodes.control import MAX_DEPTH, is_shallow
from sparseskin.nodes.errors import RefusedError
from sparseskin.nodes.lookup import did_you_mean

from .process import NodeProcess

Reply = Callable[[dict[str, Any]], None]
"""Takes the answer: {id, node, done, text}."""

LAUNCHER = "launch"
"""The name under which the launcher itself takes requests."""
PATIENCE_S = 5.0
"""How long a node may take to answer."""
MAX_OPEN = 256


@dataclass
class _Open:
    """A request that a node has not answered yet."""

    id: str
    node: str
    command: str
    reply: Reply
    deadline_s: float


class Requests:
    """Passes requests of whoever sits at the controls on to the node that owns the matter.

    Parameters
    ----------
    nodes : mapping of str to NodeProcess
        The graph's nodes.
    own : callable
        Takes (command, value, say) where the launcher itself is asked; it calls say(done, text).
    """

    def __init__(
        self,
        nodes: Mapping[str, NodeProcess],
        own: Callable[[str, Any, Callable[[bool, str], None]], None],
    ) -> None:
        self._nodes = nodes
        self._own = own
        self._open: dict[str, _Open] = {}

    def take(self, request: Mapping[str, Any], reply: Reply) -> None:
        """Pass on one request {id, node, command, value}; the reply is called once."""
        number, node, command = (request.get(key) for key in ("id", "node", "command"))
        said = _Open(str(number)[:64], str(node)[:64], str(command)[:64], reply, 0.0)
        if not (isinstance(number, str) and isinstance(node, str) and isinstance(command, str)):
            _answer(said, False, "expected the texts id, node and command")
        elif not is_shallow(request.get("value")):
            _answer(said, False, f"value: nested more than {MAX_DEPTH} deep")
        elif node == LAUNCHER:
            try:
                self._own(command, request.get("value"), lambda *what: _answer(said, *what))
            except RefusedError as error:
                _answer(said, False, str(error))
        elif fault := self._fault(node, command, request.get("value")):
            _answer(said, False, fault)
        else:
            said.deadline_s = time.monotonic() + PATIENCE_S
            key = secrets.token_hex(8)
            self._open[key] = said
            self._nodes[node].command(command, id=key, value=request.get("value"))

    def answered(self, event: Mapping[str, Any]) -> None:
        """A node has answered."""
        said = self._open.pop(event["id"], None)
        if said is not None:
            _answer(said, event["done"], event["text"])

    def expire(self) -> None:
        """Answer in place of nodes that do not."""
        now_s = time.monotonic()
        for key, said in list(self._open.items()):
            node = self._nodes.get(said.node)
            gone = node is None or node.exit_code() is not None
            if gone or said.deadline_s < now_s:
                del self._open[key]
                why = "has ended" if gone else f"has not answered within {PATIENCE_S:g} s"
                _answer(said, False, f"{said.node} {why}")

    def _fault(self, node: str, command: str, value: Any) -> str:
        """Why a request cannot be passed on; "" where it can."""
        if node not in self._nodes:
            return f"{node[:64]}: no such node{did_you_mean(node, [*self._nodes, LAUNCHER])}"
        process = self._nodes[node]
        known = ("set", *process.spec.cls.commands)
        if command not in known:
            return f"{node}: knows no command '{command[:64]}'{did_you_mean(command, known)}"
        if command == "set" and not (isinstance(value, dict) and value):
            return f"{node}: set: expected settings and their values"
        if not process.ready or process.ended or process.exit_code() is not None:
            return f"{node} does not run just now"
        if len(self._open) >= MAX_OPEN:
            return f"{MAX_OPEN} requests wait for an answer already"
        return ""


def _answer(said: _Open, done: bool, text: str) -> None:
    said.reply({"id": said.id, "node": said.node, "done": done, "text": text})
