"""The bridge `foxglove`: a server that Foxglove and Lichtblick open as a live connection."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, cast

from sparseskin.messages import Message, Resultant, SkinState
from sparseskin.messages.topics import topic_of
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.node import Context
from sparseskin.nodes.settings import setting

from .base import LOOPBACK, Bridge, BridgeSettings, Map, check_installed, figures
from .exports.foxglove import grid, numbers_schema, point_cloud, raw_image

BACKLOG = 1024
"""Messages that the server keeps for a client that reads slowly; beyond it drops the oldest."""


@dataclass(frozen=True)
class FoxgloveSettings(BridgeSettings):
    """Settings of the bridge `foxglove`."""

    host: str = setting("127.0.0.1", "address to listen at; others let other hosts in, unprotected")
    port: int = setting(8765, "port of the server; 0: a free one", low=0, high=65535)

    def check(self) -> None:
        check_installed("foxglove", "type foxglove")


class FoxgloveBridge(Bridge[FoxgloveSettings]):
    """Sends each map as `foxglove.RawImage` (32FC1) and `foxglove.Grid`, its figures as JSON; of a
    skin of points as `foxglove.PointCloud`, too.

    Topics: /PATCH/SCHEMA, /PATCH/SCHEMA/grid, /PATCH/SCHEMA/figures, /PATCH/resultant. A topic
    that no client has subscribed to costs nothing.
    """

    HELP = "serve a running graph to Foxglove and Lichtblick"
    Settings = FoxgloveSettings
    patience_s = 0.008  # not visible to a person; messages are read together

    def __init__(self, settings: FoxgloveSettings, context: Context) -> None:
        super().__init__(settings, context)
        settings.check()
        import foxglove

        self._fox = foxglove
        self._own = foxglove.Context()
        self._channels: dict[str, Any] = {}
        self._listener = _Listener()
        try:
            self._server = foxglove.start_server(
                name=f"sparseskin {context.name}",
                host=settings.host,
                port=settings.port,
                capabilities=[foxglove.Capability.Time],
                server_listener=cast(Any, self._listener),  # it needs no other methods
                context=self._own,
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
                self._open(topic_of(patch, schema))
        self.context.log(f"foxglove: {self.where()}")
        if self.settings.host not in LOOPBACK:
            self.context.log("foxglove: whoever reaches that address can read the graph")
        return ()

    def where(self) -> str:
        return self._url

    def status(self) -> str:
        n = self._listener.n_clients
        return f"{super().status()} to {n} client{'' if n == 1 else 's'}"

    def send(self, message: Map, skin: SkinState) -> None:
        topic = message.topic
        image, cells, numbers = (
            self._channels[name] for name in (topic, f"{topic}/grid", f"{topic}/figures")
        )
        if image.has_sinks():
            image.log(raw_image(message, message.forces[0]), log_time=message.stamp_ns)
        if cells.has_sinks():
            layers = {"force": message.forces[0]}
            cells.log(grid(message, layers, skin), log_time=message.stamp_ns)
        if skin.points is not None:
            name = f"{topic}/points"
            if name not in self._channels:
                made = self._fox.channels.PointCloudChannel(name, context=self._own)
                self._channels[name] = made
            if self._channels[name].has_sinks():
                cloud = point_cloud(message, {"force": message.forces[0]}, skin)
                self._channels[name].log(cloud, log_time=message.stamp_ns)
        if numbers.has_sinks():
            latency_ns = self.context.clock.now_ns() - message.stamp_ns
            numbers.log(figures(message, skin.f_max, latency_ns), log_time=message.stamp_ns)

    def send_resultant(self, message: Resultant) -> None:
        channel = self._channels.get(message.topic)
        if channel is None:
            channel = self._fox.Channel(
                message.topic, schema=numbers_schema(_RESULTANT), context=self._own
            )
            self._channels[message.topic] = channel
        if channel.has_sinks():
            found = {name: getattr(message, name) for name in _RESULTANT}
            known = {name: value for name, value in found.items() if value is not None}
            channel.log(known, log_time=message.stamp_ns)

    def close(self, counts: dict[str, Any]) -> None:
        for channel in self._channels.values():
            channel.close()
        self._server.stop()

    def _open(self, topic: str) -> None:
        """Advertise the channels of a topic of maps."""
        channels = self._fox.channels
        self._channels[topic] = channels.RawImageChannel(topic, context=self._own)
        self._channels[f"{topic}/grid"] = channels.GridChannel(f"{topic}/grid", context=self._own)
        self._channels[f"{topic}/figures"] = self._fox.Channel(
            f"{topic}/figures", schema=numbers_schema(_FIGURES), context=self._own
        )


_FIGURES = (
    *("seq", "total", "peak", "row", "col", "latency_ms"),
    *("residual", "iterations", "solve_ms", "error"),
)
_RESULTANT = ("total", "total_sd", "row", "col", "row_sd", "col_sd")


class _Listener:
    """Counts clients on the threads of the server."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscribed: set[tuple[int, int]] = set()

    @property
    def n_clients(self) -> int:
        """Number of clients with a subscription."""
        with self._lock:
            return len({client for client, _ in self._subscribed})

    def on_subscribe(self, client: Any, channel: Any) -> None:
        with self._lock:
            self._subscribed.add((client.id, channel.id))

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        with self._lock:
            self._subscribed.discard((client.id, channel.id))
