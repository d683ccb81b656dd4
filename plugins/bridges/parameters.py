"""The settings of a running graph as parameters of another tool, by the names of `--set`."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterable
from typing import Any

from sparseskin.nodes.errors import RefusedError
from sparseskin.nodes.lookup import did_you_mean

PATIENCE_S = 22.0
"""Longest wait for the answer of a node, seconds: the launcher answers in its place after 20."""
MAX_OPEN = 16
"""Most requests that wait for an answer."""

Ask = Callable[[dict[str, Any]], None]


class GraphParameters:
    """Live settings of the nodes of a graph, as the launcher last reported them.

    `ask` passes a request on, None where there is no launcher. `set` waits in the thread of a
    tool; `update` and `answer` are called in that of the node.
    """

    def __init__(self, ask: Ask | None) -> None:
        self._ask = ask
        self._changed = threading.Condition()
        self._types: dict[str, str] = {}
        self._values: dict[str, Any] = {}
        self._numbers = itertools.count(1)
        self._answers: dict[str, dict[str, Any] | None] = {}

    def update(self, graph: dict[str, Any]) -> dict[str, Any]:
        """Take the state of the graph; return the values that have changed, by name."""
        values: dict[str, Any] = {}
        types: dict[str, str] = {}
        for node in graph.get("nodes", ()):
            kinds = {entry["key"]: entry["type"] for entry in node["controls"]}
            for key, value in node["settings"].items():
                if key in kinds:
                    values[f"{node['name']}.{key}"] = value
                    types[f"{node['name']}.{key}"] = kinds[key]
        with self._changed:
            new = {
                name: value
                for name, value in values.items()
                if name not in self._values or self._values[name] != value
            }
            self._values, self._types = values, types
        return new

    def answer(self, answer: dict[str, Any]) -> None:
        """Take the answer to a request."""
        with self._changed:
            if answer.get("id") in self._answers:
                self._answers[answer["id"]] = answer
                self._changed.notify_all()

    def get(self, names: Iterable[str] = ()) -> dict[str, Any]:
        """Values by name, of all parameters or of those named that there are."""
        with self._changed:
            wanted = list(names) or list(self._values)
            return {name: self._values[name] for name in wanted if name in self._values}

    def set(self, changes: dict[str, Any]) -> None:
        """Set parameters, those of one node all or none.
        Raises RefusedError with the reasons, a line each, of those that were not set.
        """
        by_node: dict[str, dict[str, Any]] = {}
        refused: list[str] = []
        with self._changed:
            known = list(self._types)
            for name, value in changes.items():
                node, dot, key = name.partition(".")
                if not dot or not any(one.startswith(f"{node}.") for one in known):
                    refused.append(f"{name[:80]}: no such parameter{did_you_mean(name, known)}")
                else:
                    kind = self._types.get(name, "")
                    by_node.setdefault(node, {})[key] = _typed(value, kind)
        for node, values in by_node.items():
            try:
                self._set(node, values)
            except RefusedError as error:
                refused.append(f"{node}: {error}")
        if refused:
            raise RefusedError("\n".join(refused))

    def _set(self, node: str, values: dict[str, Any]) -> None:
        if self._ask is None:
            raise RefusedError("no launcher can pass this on")
        number = str(next(self._numbers))
        with self._changed:
            if len(self._answers) >= MAX_OPEN:
                raise RefusedError(f"{MAX_OPEN} requests wait for an answer already")
            self._answers[number] = None
        self._ask({"id": number, "node": node, "command": "set", "value": values})
        with self._changed:
            self._changed.wait_for(lambda: self._answers[number] is not None, PATIENCE_S)
            answer = self._answers.pop(number)
            if answer is None:
                raise RefusedError(f"has not answered within {PATIENCE_S:g} s")
            if not answer["done"]:
                raise RefusedError(str(answer["text"]))
            self._values |= {f"{node}.{key}": value for key, value in values.items()}


def _typed(value: Any, kind: str) -> Any:
    """A whole number where the setting is one and the tool knows only real ones."""
    if isinstance(value, float) and value.is_integer() and "float" not in kind:
        return int(value)
    return value
