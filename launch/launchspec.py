"""What a checked launch file is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sparseskin.nodes.graph import Link
from sparseskin.nodes.node import Node

from .credentials import Credentials
from .hosts import Host, Security
from .supervision import RestartPolicy


class LaunchError(Exception):
    """A launch file that cannot be used: `lines` holds one line an error, each with its place."""

    def __init__(self, lines: Sequence[str]) -> None:
        super().__init__("\n".join(lines))
        self.lines = list(lines)


@dataclass(frozen=True)
class NodeSpec:
    """One node of a launch file; `public` is where other hosts find what it publishes."""

    name: str
    type_name: str
    cls: type[Node[Any]]
    values: dict[str, Any]
    settings: Any
    restart: RestartPolicy = RestartPolicy()
    host: str = ""
    public: str = ""

    def with_live(self, values: dict[str, Any]) -> NodeSpec:
        """The same node with what was changed while it ran."""
        before = self.settings.live_values()
        changed = {key: v for key, v in values.items() if v != before[key]}
        return replace(
            self,
            values={key: v for key, v in (self.values | changed).items() if v is not None},
            settings=replace(self.settings, **changed),
        )

    def again(self, n_restarts: int) -> NodeSpec:
        """The same node as it is started again after its n-th failure."""
        values = self.cls.values_again(self.settings, n_restarts)
        settings = replace(self.settings, **values)
        return replace(self, values=self.values | values, settings=settings)


@dataclass(frozen=True)
class LaunchFile:
    """A checked launch file; `text` is the file as it stands, with the changes of --set.

    Of a graph of several hosts, `host` is the one whose part this is, `nodes` are those that run
    there and `elsewhere` the others; "" and none as long as no host was chosen.
    """

    name: str
    description: str
    transport: str
    nodes: dict[str, NodeSpec]
    links: list[Link]
    text: str = ""
    hosts: dict[str, Host] = field(default_factory=dict)
    security: Security | None = None
    insecure: bool = False
    host: str = ""
    elsewhere: dict[str, NodeSpec] = field(default_factory=dict)
    credentials: Credentials | None = None
    log_dir: str = ""
