"""What a checked launch file is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from sparseskin.nodes.graph import Link
from sparseskin.nodes.node import Node

from .supervision import RestartPolicy


class LaunchError(Exception):
    """A launch file that cannot be used: `lines` holds one line an error, each with its place."""

    def __init__(self, lines: Sequence[str]) -> None:
        super().__init__("\n".join(lines))
        self.lines = list(lines)


@dataclass(frozen=True)
class NodeSpec:
    """One node of a launch file."""

    name: str
    type_name: str
    cls: type[Node[Any]]
    values: dict[str, Any]
    settings: Any
    restart: RestartPolicy = RestartPolicy()

    def with_live(self, values: dict[str, Any]) -> NodeSpec:
        """The same node with what was changed while it ran."""
        before = self.settings.live_values()
        changed = {key: v for key, v in values.items() if v != before[key]}
        return replace(
            self,
            values={key: v for key, v in (self.values | changed).items() if v is not None},
            settings=replace(self.settings, **changed),
        )


@dataclass(frozen=True)
class LaunchFile:
    """A checked launch file; `text` is the file as it stands, with the changes of --set."""

    name: str
    description: str
    transport: str
    nodes: dict[str, NodeSpec]
    links: list[Link]
    text: str = ""
