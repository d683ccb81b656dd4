"""A node's process as the parts of a launcher see it."""

from dataclasses import dataclass, field
from typing import Any


@dataclass
class FakeNode:
    """Stands in for a `NodeProcess`; `told` are the commands to it, each with its fields."""

    name: str = ""
    spec: Any = None
    endpoint: str = "tcp://127.0.0.1:1"
    ready: bool = False
    ended: bool = False
    failed: bool = False
    code: int | None = None
    refusal: str = ""
    heard_s: float = 0.0
    lacks: list[str] = field(default_factory=list)
    state: dict[str, Any] = field(default_factory=lambda: {"paused": False})
    counts: dict[str, Any] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)
    heard: dict[str, bool] = field(default_factory=dict)
    clocks: dict[str, tuple[int, int]] = field(default_factory=dict)
    told: list[tuple[str, dict[str, Any]]] = field(default_factory=list)

    def exit_code(self) -> int | None:
        return self.code

    def command(self, command: str, **fields: Any) -> None:
        self.told.append((command, fields))
