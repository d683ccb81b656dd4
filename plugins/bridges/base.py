"""What all bridges share: the topics that they read, what they drop, and what they report."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
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
from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.numerics.arrays import Doubles
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


@lru_cache(maxsize=64)
def _moments(n_rows: int, n_cols: int) -> tuple[Doubles, Doubles, tuple[Doubles, Doubles]]:
    """Ones and numbers of the rows; ones and numbers of the columns."""
    rows, cols = np.arange(n_rows, dtype=np.float64), np.arange(n_cols, dtype=np.float64)
    return np.ones(n_rows), rows, (np.ones(n_cols), cols)


@dataclass
class Figures:
    """Numbers of one map, as tools plot them; those that are not known are left out.

    `total` and `peak` are in the skin's unit, `row` and `col` the centre of pressure in taxels from
    the middle of the first.
    """

    seq: int
    total: float
    peak: float
    more: dict[str, float | int | bool] = field(default_factory=dict)

    @classmethod
    def of(cls, message: Map, f_max: float, latency_ns: int | None) -> Figures:
        """Figures of a map of a skin with range [0, f_max]; `latency_ns` from the acquisition."""
        forces = message.forces
        ones, rows, cols = _moments(*forces.shape)
        made = cls(message.seq, float(ones @ (sums := forces @ cols[0])), float(forces.max()))
        if made.total > 0 and made.peak > CONTACT_FRACTION * f_max:
            made.more["row"] = float(rows @ sums) / made.total
            made.more["col"] = float(ones @ (forces @ cols[1])) / made.total
        if latency_ns is not None:
            made.more["latency_ms"] = latency_ns / 1e6
        if isinstance(message, Reconstruction):
            made.more |= {
                "residual": message.residual,
                "iterations": message.iterations,
                "solve_ms": message.solve_ns / 1e6,
                "trusted": message.trusted,
            }
            if message.error is not None:
                made.more["error"] = message.error
        return made

    def as_dict(self) -> dict[str, float | int | bool]:
        """All of them by name; finite, so that JSON can hold them."""
        found = {"seq": self.seq, "total": self.total, "peak": self.peak, **self.more}
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
            skin = self.skins.get(message.patch)
            if skin is None or skin.skin.shape != message.forces.shape:
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
