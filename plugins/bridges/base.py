"""What all bridges share: the topics that they read, what they drop, and what they report."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, ClassVar, TypeVar

import numpy as np

from sparseskin.messages import (
    Contacts,
    Message,
    Reconstruction,
    SkinState,
    Taxels,
    Truth,
    topic_of,
)
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.errors import SettingsError, SparseskinError, not_installed
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.settings import Settings, check_patch, setting

Map = Taxels | Truth | Reconstruction
MAPS = {cls.schema: cls for cls in (Reconstruction, Truth, Taxels)}
SENT = tuple(MAPS)
"""Schemas whose forces a bridge can send."""
ROW = "row"
"""Column of a cloud of points: the row of each in its file, uint32."""
LOOPBACK = ("127.0.0.1", "localhost", "::1")


def check_words(key: str, words: Iterable[str], allowed: Collection[str]) -> None:
    """Raise SettingsError if a word of a setting is not allowed."""
    for k, word in enumerate(words):
        if word not in allowed:
            raise SettingsError(
                f"{key}[{k}]: {word!r} is not allowed{did_you_mean(word, allowed)}"
            )


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
        # A name may become part of a topic of the other tool.
        for k, patch in enumerate(self.patches):
            check_patch(f"patches[{k}]", patch)
        if not self.maps:
            raise SettingsError(f"maps: expected at least one of {', '.join(SENT)}")
        check_words("maps", self.maps, SENT)


S = TypeVar("S", bound=BridgeSettings)


UNKNOWN_PITCH_M = 1.0
"""Pitch of a skin that states none, metres: places then count taxels."""


def check_installed(
    what: str, extra: str, *modules: str, error: type[SparseskinError] = SettingsError
) -> None:
    """Raise `error` unless the modules of an extra that `what` needs are installed."""
    for module in modules:
        if find_spec(module) is None:
            # Most packages are imported by the name under which they are installed.
            package = {"foxglove": "foxglove-sdk"}.get(module, module)
            raise error(f"{what}: {not_installed(package, extra)}")


def point_columns(
    skin: SkinState, layers: Mapping[str, Floats], normals: bool = False
) -> dict[str, Floats]:
    """Columns of a cloud of the taxels that exist, float32 (n_taxels,): x, y, z in metres, the
    layers, each (n_rows, n_cols), and of points from a file the normals, where they are wanted, and
    `row`, the bits of uint32. On a flat grid x runs along the columns and y along the rows.
    """
    exists = skin.skin.exists
    if skin.points is None:
        rows, cols = np.nonzero(exists)
        pitch_m = skin.pitch_m or UNKNOWN_PITCH_M
        of_points = pitch_m * np.stack([cols, rows, np.zeros_like(rows)])
    else:
        # Places, and behind them the normals.
        of_points = skin.points.T
    columns = dict(zip("xyz", of_points.astype(np.float32), strict=False))
    columns |= {name: layer[exists] for name, layer in layers.items()}
    if normals:
        columns |= dict(zip(("nx", "ny", "nz"), of_points[3:], strict=True))
    if skin.point_rows is not None:
        # All columns of a cloud have one dtype; a float32 would round large numbers.
        columns[ROW] = skin.point_rows.astype("<u4").view("<f4")
    return columns


class Bridge(Node[S]):
    """A node that sends the forces of patches out of the graph.

    No writer waits for it. Where it is behind, the oldest messages are dropped: by itself beyond
    `depth` (skipped), by a writer beyond its queue (lost); both are counted, as are frames that
    come before their skin.
    """

    HELP: ClassVar[str] = "show a running graph to another tool"
    """One line of `sparseskin bridge`."""
    EXTRAS: ClassVar[tuple[str, ...]] = (Contacts.schema,)
    """Schemas that are sent besides `maps`."""
    required = False
    observes = True

    def __init__(self, settings: S, context: Context) -> None:
        super().__init__(settings, context)
        self.skins: dict[str, SkinState] = {}
        self._held: dict[str, dict[str, Floats]] = {}
        self._next: dict[str, int] = {}
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
        topics: list[str] = []
        for patch in settings.patches:
            topics += [topic_of(patch, schema) for schema in settings.maps]
            topics += [topic_of(patch, schema) for schema in cls.EXTRAS]
        return tuple(topics)

    def step(self, message: Message) -> Iterable[Message]:
        # The newest skin is that of all frames that follow.
        if isinstance(message, SkinState):
            self.skins[message.patch] = message
        elif isinstance(message, Taxels | Truth | Reconstruction | Contacts):
            topic = message.topic
            skin = self.skins.get(message.patch)
            # A frame that a later one refers to may be dropped.
            if message.seq != self._next.get(topic):
                self._held[topic] = {}
            self._next[topic] = message.seq + 1
            # None comes before the first frame that is solved.
            for part in message.split(self._held[topic]):
                self._send(part, skin)
        return ()

    def _send(self, message: Map | Contacts, skin: SkinState | None) -> None:
        # The skin may arrive on another connection than its frames.
        if skin is None or not _fits(message, skin):
            self.n_dropped += 1
            return
        self.send(message, skin)
        self.n_sent += 1

    def send(self, message: Map | Contacts, skin: SkinState) -> None:
        """Send a map or the contacts of one patch."""
        raise NotImplementedError

    def overtaken(self, message: Message) -> None:
        self.n_dropped += 1

    def where(self) -> str:
        """Address at which tools find the bridge."""
        raise NotImplementedError

    def status(self) -> str:
        text = f"{self.where()}: {self.n_sent} frames published"
        if self.n_dropped:
            text += f", {self.n_dropped} dropped"
        return text

    def report(self) -> dict[str, Any]:
        counts = {"sent": self.n_sent, "dropped": self.n_dropped}
        return {"bridge": {"where": self.where(), **counts}}


def _fits(message: Map | Contacts, skin: SkinState) -> bool:
    if isinstance(message, Contacts):
        return True
    # After a restart of the sensor, frames of the old shape may still be on their way.
    return message.forces.shape[1:] == skin.skin.shape


def patches_of(topics: Iterable[str]) -> list[str]:
    """Patches of which there is a skin, in order."""
    pairs = (split_topic(topic) for topic in topics)
    return [patch for patch, schema in pairs if schema == SkinState.schema]
