"""The bridge `foxglove`: a server that Foxglove and Lichtblick open as a live connection."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from sparseskin.messages import Message, SkinState
from sparseskin.messages.topics import topic_of
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.node import Context
from sparseskin.nodes.settings import setting

from .base import LOOPBACK, MAPS, Bridge, BridgeSettings, check_installed
from .exports.foxglove import Channels, contents, figures_schema

BACKLOG = 1024
"""Messages that the server keeps for a client that reads slowly; beyond it drops the oldest."""


@dataclass(frozen=True)
class FoxgloveSettings(BridgeSettings):
    """Settings of the bridge `foxglove`."""

    host: str = setting(
        "127.0.0.1", "address to listen at; others let other hosts in, unprotected"
    )
    port: int = setting(8765, "port of the server; 0: a free one", low=0, high=65535)

    def check(self) -> None:
        check_installed("type foxglove", "foxglove", "foxglove")


class FoxgloveBridge(Bridge[FoxgloveSettings]):
    """Sends what an export to Foxglove writes; a topic without a subscriber costs nothing."""

    HELP = "serve a running graph to Foxglove and Lichtblick"
    Settings = FoxgloveSettings
    # Not visible to a person; messages are read together.
    patience_s = 0.008

    def __init__(self, settings: FoxgloveSettings, context: Context) -> None:
        super().__init__(settings, context)
        settings.check()
        # Optional: only a bridge that runs needs it.
        import foxglove

        # A context of its own keeps its channels apart from those of other servers in this process.
        context_of_bridge = foxglove.Context()
        self._channels = Channels(context_of_bridge)
        try:
            self._server = foxglove.start_server(
                name=f"sparseskin {context.name}",
                host=settings.host,
                port=settings.port,
                capabilities=[foxglove.Capability.Time],
                context=context_of_bridge,
                message_backlog_size=BACKLOG,
            )
        except (RuntimeError, OSError, ValueError) as error:
            raise SettingsError(
                f"port: cannot listen at {settings.host}:{settings.port}: {one_line(error)}; "
                "0: a free one"
            ) from error
        self._url = f"ws://{settings.host}:{self._server.port}"

    def start(self) -> Iterable[Message]:
        # Channels exist before the first frame, so that panels can be laid out at once.
        for patch in self.settings.patches:
            for schema in self.settings.maps:
                topic = topic_of(patch, schema)
                self._channels.of(topic, "RawImage")
                self._channels.of(f"{topic}/grid", "Grid")
                figures = figures_schema(MAPS[schema], ("seq", "latency_ms"))
                self._channels.of(f"{topic}/figures", figures)
        self.context.log(f"foxglove: {self.where()}")
        if self.settings.host not in LOOPBACK:
            self.context.log(
                "foxglove: whoever reaches that address can read the graph"
            )
        return ()

    def where(self) -> str:
        return self._url

    def send(self, message: Message, skin: SkinState) -> None:
        # Age of the frame when it is sent: what a viewer cannot compute by itself.
        late_ms = (self.context.clock.now_ns() - message.stamp_ns) / 1e6
        figures = {"seq": message.seq, "latency_ms": late_ms}
        for topic, schema, make in contents(message, skin, figures):
            channel = self._channels.of(topic, schema)
            # A message that nobody reads is not made.
            if channel.has_sinks():
                channel.log(make(), log_time=message.stamp_ns)

    def close(self, counts: dict[str, Any]) -> None:
        # Clients see the topics go before the connection does.
        for channel in self._channels.values():
            channel.close()
        self._server.stop()
