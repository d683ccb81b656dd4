"""The bridge `foxglove`: a server that Foxglove and Lichtblick open as a live connection."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

from sparseskin.messages import Message, Resultant, SkinState
from sparseskin.messages.topics import topic_of
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.node import Context
from sparseskin.nodes.settings import setting

from .base import LOOPBACK, RESULTANT, Bridge, BridgeSettings, Map, check_installed, figures
from .exports.foxglove import Channels, figures_of, grid, point_cloud, raw_image

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

        own = foxglove.Context()
        self._channels = Channels(own)
        self._listener = _Listener()
        try:
            self._server = foxglove.start_server(
                name=f"sparseskin {context.name}",
                host=settings.host,
                port=settings.port,
                capabilities=[foxglove.Capability.Time],
                server_listener=cast(Any, self._listener),  # it needs no other methods
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
                self._channels.of(f"{topic}/figures", _FIGURES)
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
        layers = {"force": message.forces[0]}
        late_ns = self.context.clock.now_ns() - message.stamp_ns
        self._log(message, "", "RawImage", lambda: raw_image(message, message.forces[0]))
        self._log(message, "/grid", "Grid", lambda: grid(message, layers, skin))
        if skin.points is not None:
            self._log(message, "/points", "PointCloud", lambda: point_cloud(message, layers, skin))
        self._log(message, "/figures", _FIGURES, lambda: figures(message, skin.f_max, late_ns))

    def send_resultant(self, message: Resultant) -> None:
        self._log(message, "", RESULTANT, lambda: figures_of(message, RESULTANT))

    def close(self, counts: dict[str, Any]) -> None:
        for channel in self._channels.values():
            channel.close()
        self._server.stop()

    def _log(
        self, message: Message, ending: str, schema: str | Sequence[str], make: Callable[[], Any]
    ) -> None:
        """Log what `make` returns, where a client has subscribed to the topic with that ending."""
        channel = self._channels.of(message.topic + ending, schema)
        if channel.has_sinks():
            channel.log(make(), log_time=message.stamp_ns)


_FIGURES = (
    *("seq", "total", "peak", "row", "col", "latency_ms"),
    *("residual", "iterations", "solve_ms", "error"),
)


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
