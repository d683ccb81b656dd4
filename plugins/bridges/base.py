"""What all bridges share: the topics that they read, what they drop, and what they report."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, ClassVar, TypeVar

import numpy as np

from sparseskin.messages import (
    Message,
    Reconstruction,
    Resultant,
    SkinState,
    Taxels,
    Truth,
    topic_of,
)
from sparseskin.messages.frames import values_alone
from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.errors import RefusedError, SettingsError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.settings import Settings, check_patch, setting

Map = Taxels | Truth | Reconstruction
SENT = ("reconstruction", "truth", "taxels")
"""Schemas whose forces a bridge can send."""
LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class BridgeSettings(Settings):
    """Settings of all bridges."""

    patches: tuple[str, ...] = setting(("skin",), "names of the patches to send")
    maps: tuple[str, ...] = setting(
        SENT, f"which forces to send, those of them that there are: {', '.join(SENT)}"
    )
    depth: int = setting(
        100,
        "most messages of a topic that may wait; older ones are dropped and counted",
        low=1,
        high=1000,
        live=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.patches:
            raise SettingsError("patches: expected at least one name")
        for k, patch in enumerate(self.patches):
            check_patch(f"patches[{k}]", patch)
        if not self.maps:
            raise SettingsError(f"maps: expected at least one of {', '.join(SENT)}")
        for k, schema in enumerate(self.maps):
            if schema not in SENT:
                raise SettingsError(
                    f"maps[{k}]: {schema!r} is not allowed{did_you_mean(schema, SENT)}"
                )


S = TypeVar("S", bound=BridgeSettings)


PACKAGES = {"foxglove": {"foxglove": "foxglove-sdk"}, "ros2": {"cyclonedds": "", "rosbags": ""}}
"""Modules that the bridges of an extra need, and their packages where these have other names."""


def check_installed(extra: str, what: str) -> None:
    """Raise SettingsError if a module that the bridges of an extra need is not installed."""
    for module, package in PACKAGES[extra].items():
        if find_spec(module) is None:
            raise SettingsError(
                f'{what} needs {package or module}; pip install "sparseskin[{extra}]"'
            )


def figures(message: Map, f_max: float, latency_ns: int) -> dict[str, float | int | bool]:
    """Numbers of a map of a skin with range [0, f_max], as tools plot them; finite, and without
    those that are not known. `latency_ns` is the time since the acquisition.

    `total` and `peak` are in the skin's unit, `row` and `col` the centre of pressure in taxels from
    the middle of the first.
    """
    values = values_alone(message)
    forces = values["forces"]
    rows, cols = forces.sum(axis=1, dtype=np.float64), forces.sum(axis=0, dtype=np.float64)
    total, peak = float(rows.sum()), float(forces.max())
    found: dict[str, float | int | bool] = {"seq": message.seq, "total": total, "peak": peak}
    if total > 0 and peak > CONTACT_FRACTION * f_max:
        found["row"] = float(rows @ np.arange(len(rows))) / total
        found["col"] = float(cols @ np.arange(len(cols))) / total
    found["latency_ms"] = latency_ns / 1e6
    if isinstance(message, Reconstruction):
        found |= {name: values[name] for name in ("residual", "iterations", "trusted")}
        found["solve_ms"] = values["solve_ns"] / 1e6
        if values["error"] is not None:
            found["error"] = values["error"]
    return {name: value for name, value in found.items() if math.isfinite(value)}


class Bridge(Node[S]):
    """A node that sends the forces of patches out of the graph.

    No writer waits for it. Where it is behind, the oldest messages are dropped: by itself beyond
    `depth` (skipped), by a writer beyond its queue (lost); both are counted, as are frames that
    come before their skin.
    """

    HELP: ClassVar[str] = "show a running graph to another tool"
    """One line of `sparseskin bridge`."""
    required = False
    observes = True

    def __init__(self, settings: S, context: Context) -> None:
        super().__init__(settings, context)
        self.skins: dict[str, SkinState] = {}
        self.n_sent = 0
        self.n_dropped = 0

    @property
    def depth(self) -> int:
        return self.settings.depth

    @classmethod
    def inputs(cls, settings: S) -> tuple[str, ...]:
        return tuple(topic_of(patch, SkinState.schema) for patch in settings.patches)

    @classmethod
    def optional_inputs(cls, settings: S) -> tuple[str, ...]:
        schemas = (*settings.maps, Resultant.schema)
        return tuple(topic_of(patch, schema) for patch in settings.patches for schema in schemas)

    def step(self, message: Message) -> Iterable[Message]:
        if isinstance(message, SkinState):
            self.skins[message.patch] = message
        elif isinstance(message, Taxels | Truth | Reconstruction):
            if message.names:
                raise RefusedError(f"{message.topic}: a bridge shows no patches of a batch")
            skin = self.skins.get(message.patch)
            if skin is None or skin.skin.shape != message.forces.shape[1:]:
                # The skin may arrive on another connection than its frames.
                self.n_dropped += 1
                return ()
            self.send(message, skin)
            self.n_sent += 1
        elif isinstance(message, Resultant):
            self.send_resultant(message)
        return ()

    def send(self, message: Map, skin: SkinState) -> None:
        """Send one map."""
        raise NotImplementedError

    def send_resultant(self, message: Resultant) -> None:
        """Send one resultant, where the tool has a place for it."""

    def overtaken(self, message: Message) -> None:
        self.n_dropped += 1

    def where(self) -> str:
        """Address at which tools find the bridge."""
        raise NotImplementedError

    def status(self) -> str:
        dropped = f", {self.n_dropped} dropped" if self.n_dropped else ""
        return f"{self.where()}: {self.n_sent} frames published{dropped}"

    def report(self) -> dict[str, Any]:
        return {"bridge": {"where": self.where(), "sent": self.n_sent, "dropped": self.n_dropped}}


def patches_of(topics: Iterable[str]) -> list[str]:
    """Patches of which there is a skin, in order."""
    found = (split_topic(topic) for topic in topics)
    return list(dict.fromkeys(patch for patch, schema in found if schema == SkinState.schema))
