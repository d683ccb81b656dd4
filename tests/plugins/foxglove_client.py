"""A client of Foxglove's websocket protocol, independent of its SDK.

Source: github.com/foxglove/ws-protocol; the subprotocol of today's servers is foxglove.sdk.v1.
"""

from __future__ import annotations

import base64
import contextlib
import json
import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from websockets.sync.client import connect

MESSAGE_DATA = 1


class Data(NamedTuple):
    """A message: topic of the channel, time of the log in ns, content by the server's schema."""

    topic: str
    log_time_ns: int
    content: Any


class FoxgloveClient:
    """A connection to a server; `texts` are the JSON messages that came so far."""

    def __init__(self, url: str) -> None:
        self._stack = contextlib.ExitStack()
        connecting = connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None)
        self._socket = self._stack.enter_context(connecting)
        self.channels: dict[str, dict[str, Any]] = {}
        self._topics: dict[int, str] = {}
        self._factory = DecoderFactory()

    def __enter__(self) -> FoxgloveClient:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def receive(self, timeout_s: float = 60.0) -> Data | dict[str, Any]:
        """The next message: of a subscription, or a JSON object."""
        while True:
            got = self._socket.recv(timeout=timeout_s)
            if isinstance(got, str):
                found: dict[str, Any] = json.loads(got)
                for channel in found.get("channels", ()):
                    self.channels[channel["topic"]] = channel
                return found
            if got[0] == MESSAGE_DATA:
                number, at_ns = struct.unpack_from("<IQ", got, 1)
                return Data(
                    self._topics[number], at_ns, self._content(number, got[13:])
                )

    def _content(self, number: int, payload: bytes) -> Any:
        channel = self.channels[self._topics[number]]
        if channel["encoding"] == "json":
            return json.loads(payload)
        schema = base64.b64decode(channel["schema"])
        described = Schema(channel["id"], schema, "protobuf", channel["schemaName"])
        decode = self._factory.decoder_for("protobuf", described)
        assert decode is not None
        return decode(payload)

    def data(self) -> Data:
        """The next message of a subscription; all else is left out."""
        while not isinstance(got := self.receive(), Data):
            pass
        return got

    def wait_for_channels(self, *topics: str) -> None:
        while not set(topics) <= self.channels.keys():
            self.receive()

    def subscribe(self, *topics: str) -> None:
        """Subscribe to channels that were advertised."""
        self._topics = dict(enumerate(topics, start=1))
        wanted = [
            {"id": number, "channelId": self.channels[topic]["id"]}
            for number, topic in self._topics.items()
        ]
        self.send(op="subscribe", subscriptions=wanted)

    def send(self, **fields: Any) -> None:
        self._socket.send(json.dumps(fields))


def pixels(image: Any) -> npt.NDArray[np.float32]:
    """Pixels of a foxglove.RawImage in 32FC1."""
    assert image.encoding == "32FC1"
    assert image.step == 4 * image.width
    return np.frombuffer(image.data, "<f4").reshape(image.height, image.width)
