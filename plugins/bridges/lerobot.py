"""The bridge `lerobot`: a skin as a camera of LeRobot, by its ZMQ protocol.

Source of the protocol: huggingface/lerobot, src/lerobot/cameras/zmq/camera_zmq.py, version 0.6.2:
one part, JSON {"timestamps": {NAME: seconds}, "images": {NAME: base64 of an image file}}.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import zmq

from sparseskin.messages import Message, SkinState
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.network.sockets import make_context
from sparseskin.nodes.node import Context
from sparseskin.nodes.settings import setting

from .base import LOOPBACK, SENT, Bridge, BridgeSettings, Map, camera
from .png import greys, png

MAX_NOTE_BYTES = 1024


@dataclass(frozen=True)
class LeRobotSettings(BridgeSettings):
    """Settings of the bridge `lerobot`."""

    maps: tuple[str, ...] = setting(
        ("reconstruction",), f"which forces to send, one camera each: {', '.join(SENT)}"
    )
    host: str = setting("127.0.0.1", "address to bind; others let other hosts in, unprotected")
    port: int = setting(5555, "port of the cameras; 0: a free one", low=0, high=65535)
    rate_hz: float = setting(
        30.0, "most images a second, the newest each time; 0: every frame", low=0.0, high=10_000.0
    )
    full_scale: float | None = setting(
        None, "force of the grey level 255; the upper end of the skin's range by default", low=1e-9
    )
    pixels: int = setting(1, "pixels a side of each taxel", low=1, high=64)


class LeRobotBridge(Bridge[LeRobotSettings]):
    """Serves one camera for each map, named PATCH for the reconstruction, PATCH_MAP for others.

    A grey level is round(255 force / full_scale); the timestamp is that of the acquisition. Only
    the newest image waits for a client that is behind.
    """

    HELP = "serve a running graph as a ZMQ camera of LeRobot"
    Settings = LeRobotSettings
    patience_s = 0.008  # a quarter of the time between two images; messages are read together

    def __init__(self, settings: LeRobotSettings, context: Context) -> None:
        super().__init__(settings, context)
        self.n_between = 0
        self._context = make_context()
        self._socket = self._context.socket(zmq.PUB)
        # As that of LeRobot does; it holds for messages of one part.
        self._socket.setsockopt(zmq.CONFLATE, 1)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_NOTE_BYTES)
        self._due_ns: dict[str, int] = {}
        port = str(settings.port) if settings.port else "*"
        try:
            self._socket.bind(f"tcp://{settings.host}:{port}")
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise SettingsError(
                f"port: cannot bind {settings.host}:{port}: {error}; 0: a free one"
            ) from error
        bound = self._socket.getsockopt(zmq.LAST_ENDPOINT)
        assert isinstance(bound, bytes)
        self._endpoint = bound.rstrip(b"\0").decode()

    def start(self) -> Iterable[Message]:
        names = [camera(patch, s) for patch in self.settings.patches for s in self.settings.maps]
        self.context.log(f"lerobot: {self.where()} (camera_name: {', '.join(names)})")
        if self.settings.host not in LOOPBACK:
            self.context.log("lerobot: whoever reaches that address can see the skin")
        return ()

    def where(self) -> str:
        return self._endpoint

    def step(self, message: Message) -> Iterable[Message]:
        if isinstance(message, Map) and self._is_early(message):
            self.n_between += 1
            return ()
        return super().step(message)

    def send(self, message: Map, skin: SkinState) -> None:
        grey = greys(message.forces[0], self.settings.full_scale or skin.f_max)
        if self.settings.pixels > 1:
            side = self.settings.pixels
            grey = np.repeat(np.repeat(grey, side, axis=0), side, axis=1)
        name = camera(message.patch, message.schema)
        made = {
            "timestamps": {name: message.stamp_ns / 1e9},
            "images": {name: base64.b64encode(png(grey)).decode()},
        }
        self._socket.send(json.dumps(made).encode(), zmq.NOBLOCK)

    def report(self) -> dict[str, Any]:
        report = super().report()
        report["bridge"]["between"] = self.n_between
        return report

    def close(self, counts: dict[str, Any]) -> None:
        self._context.destroy(linger=0)

    def _is_early(self, message: Map) -> bool:
        """True for a frame that comes before the next image of its camera is due."""
        if not self.settings.rate_hz:
            return False
        period_ns = round(1e9 / self.settings.rate_hz)
        due_ns = self._due_ns.get(message.topic, message.stamp_ns)
        if message.stamp_ns < due_ns and due_ns - message.stamp_ns <= period_ns:
            return True
        # On absolute targets, or from anew after a gap.
        behind = message.stamp_ns - due_ns
        begun = due_ns if 0 <= behind < period_ns else message.stamp_ns
        self._due_ns[message.topic] = begun + period_ns
        return False
