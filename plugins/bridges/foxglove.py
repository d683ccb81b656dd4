"""The bridge `foxglove`: a server that Foxglove and Lichtblick open as a live connection."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from sparseskin.messages import Contacts, Message, Resultant, SkinState
from sparseskin.messages.topics import topic_of
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.node import Context
from sparseskin.nodes.settings import setting

from .base import LOOPBACK, MAPS, RESULTANT, Bridge, BridgeSettings, Map, check_installed
from .contacts import as_json, json_schema
from .exports.foxglove import (
    Channels,
    Schema,
    contact_scene,
    figure_names,
    figures_of,
    grid,
    point_cloud,
    raw_image,
)

BACKLOG = 1024
"""Messages that the server keeps for a client that reads slowly; beyond it drops the oldest."""


@dataclass(frozen=True)
class FoxgloveSettings(BridgeSettings):
    """Settings of the bridge `foxglove`."""

    host: str = setting("127.0.0.1", "address to listen at; others let other hosts in, unprotected")
    port: int = setting(8765, "port of the server; 0: a free one", low=0, high=65535)

    def check(self) -> None:
        check_installed("type foxglove", "foxglove", "foxglove")


class FoxgloveBridge(Bridge[FoxgloveSettings]):
    """Sends each map as `foxglove.RawImage` (32FC1) and `foxglove.Grid`, its figures as JSON; of a
    skin of points as `foxglove.PointCloud`, too.

    Topics: /PATCH/SCHEMA, /PATCH/SCHEMA/grid, /PATCH/SCHEMA/figures, /PATCH/resultant, and
    /PATCH/contacts as JSON, /PATCH/contacts/scene as `foxglove.SceneUpdate`. A topic that no client
    has subscribed to costs nothing.
    """

    HELP = "serve a running graph to Foxglove and Lichtblick"
    Settings = FoxgloveSettings
    patience_s = 0.008  # not visible to a person; messages are read together

    def __init__(self, settings: FoxgloveSettings, context: Context) -> None:
        super().__init__(settings, context)
        settings.check()
        import foxglove

        own = foxglove.Context()
        self._channels = Channels(own)
        try:
            self._server = foxglove.start_server(
                name=f"sparseskin {context.name}",
                host=settings.host,
                port=settings.port,
                capabilities=[foxglove.Capability.Time],
                context=own,
                message_backlog_size=BACKLOG,
            )
        except (RuntimeError, OSError, ValueError) as error:
            raise SettingsError(
                f"port: cannot listen at {settings.host}:{settings.port}: {one_line(error)}; "
                "0: a free one"
            ) from error
        self._url = f"ws://{settings.host}:{self._server.port}"

    def start(self) -> Iterable[Message]:
        for patch in self.settings.patches:
            for schema in self.settings.maps:
                topic = topic_of(patch, schema)
                self._channels.of(topic, "RawImage")
                self._channels.of(f"{topic}/grid", "Grid")
                self._channels.of(f"{topic}/figures", _names(MAPS[schema]))
        self.context.log(f"foxglove: {self.where()}")
        if self.settings.host not in LOOPBACK:
            self.context.log("foxglove: whoever reaches that address can read the graph")
        return ()

    def where(self) -> str:
        return self._url

    def send(self, message: Map, skin: SkinState) -> None:
        layers = {"force": message.forces[0]}
        now = {
            "seq": message.seq,
            "latency_ms": (self.context.clock.now_ns() - message.stamp_ns) / 1e6,
        }
        self._log(message, "", "RawImage", lambda: raw_image(message, message.forces[0]))
        self._log(message, "/grid", "Grid", lambda: grid(message, layers, skin))
        if skin.points is not None:
            self._log(message, "/points", "PointCloud", lambda: point_cloud(message, layers, skin))
        names = _names(type(message))
        self._log(message, "/figures", names, lambda: figures_of(message) | now)

    def send_contacts(self, message: Contacts, skin: SkinState) -> None:
        self._log(message, "", json_schema(message), lambda: as_json(message))
        self._log(message, "/scene", "SceneUpdate", lambda: contact_scene(message, skin))

    def send_resultant(self, message: Resultant) -> None:
        self._log(message, "", RESULTANT, lambda: figures_of(message, RESULTANT))

    def close(self, counts: dict[str, Any]) -> None:
        for channel in self._channels.values():
            channel.close()
        self._server.stop()

    def _log(self, message: Message, ending: str, schema: Schema, make: Callable[[], Any]) -> None:
        """Log what `make` returns, where a client has subscribed to the topic with that ending."""
        channel = self._channels.of(message.topic + ending, schema)
        if channel.has_sinks():
            channel.log(make(), log_time=message.stamp_ns)


def _names(cls: type[Map]) -> list[str]:
    """Names of the numbers that are sent of a map."""
    return [*figure_names(cls), "seq", "latency_ms"]
