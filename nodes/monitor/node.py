"""The monitor: watches patches and says how good, how fast and how complete they are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from sparseskin.messages import (
    Measurements,
    Message,
    PhiState,
    Reconstruction,
    SkinState,
    SolverState,
    Taxels,
    Truth,
    topic_of,
)
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.settings import Settings, check_patch, setting

from .metrics import PatchMetrics
from .table import status_line

WATCHED = (SkinState, Taxels, Truth, PhiState, Measurements, SolverState, Reconstruction)


@dataclass(frozen=True)
class MonitorSettings(Settings):
    """What a monitor can be told."""

    patches: tuple[str, ...] = setting(("skin",), "names of the patches to watch")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.patches:
            raise SettingsError("patches: expected at least one name")
        for k, patch in enumerate(self.patches):
            check_patch(f"patches[{k}]", patch)


class Monitor(Node[MonitorSettings]):
    """Publishes nothing; its status is a line, its report the summary of every patch."""

    Settings = MonitorSettings

    def __init__(self, settings: MonitorSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._patches = {patch: PatchMetrics() for patch in settings.patches}
        self._said_ns = context.clock.now_ns()
        self._said_frames = dict.fromkeys(settings.patches, 0)

    @classmethod
    def inputs(cls, settings: MonitorSettings) -> tuple[str, ...]:
        return tuple(
            topic_of(patch, watched.schema) for patch in settings.patches for watched in WATCHED
        )

    def step(self, message: Message) -> Iterable[Message]:
        self._patches[message.patch].add(message)
        return ()

    def ended(self, topic: str, n_messages: int) -> Iterable[Message]:
        patch, schema = split_topic(topic)
        self._patches[patch].end(schema, n_messages)
        return ()

    def status(self) -> str:
        now_ns = self.context.clock.now_ns()
        seconds = (now_ns - self._said_ns) / 1e9
        self._said_ns = now_ns
        lines = []
        for patch, metrics in self._patches.items():
            new = metrics.reconstructed - self._said_frames[patch]
            self._said_frames[patch] = metrics.reconstructed
            lines.append(status_line(patch, metrics, new / seconds if seconds > 0 else 0.0))
        return "  ||  ".join(lines)

    def report(self) -> dict[str, Any]:
        return {"patches": {name: metrics.summary() for name, metrics in self._patches.items()}}
