"""A client of Foxglove's websocket protocol, independent of its SDK.

Source: github.com/foxglove/ws-protocol; the subprotocol of today's servers is foxglove.sdk.v1.
"""

from __future__ import annotations

import contextlib
import json
import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from websockets.sync.client import connect

MESSAGE_DATA = 1


class Data(NamedTuple):
    """A message of a subscription: the channel's topic, the time of the log in ns, its bytes."""

    topic: str
    log_time_ns: int
    payload: bytes


class FoxgloveClient:
    """A connection to a server; `texts` are the JSON messages that came so far."""

    def __init__(self, url: str) -> None:
        self._stack = contextlib.ExitStack()
        connecting = connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None)  # type: ignore[list-item]
        self._socket = self._stack.enter_context(connecting)
        self.channels: dict[str, dict[str, Any]] = {}
        self.info: dict[str, Any] = {}
        self._topics: dict[int, str] = {}

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
                if found["op"] == "serverInfo":
                    self.info = found
                return found
            if got[0] == MESSAGE_DATA:
                number, at_ns = struct.unpack_from("<IQ", got, 1)
                return Data(self._topics[number], at_ns, got[13:])

    def until(self, op: str) -> dict[str, Any]:
        """The next JSON object of this kind; all else is left out."""
        while True:
            found = self.receive()
            if isinstance(found, dict) and found["op"] == op:
                return found

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

    def parameters(self, *names: str) -> dict[str, Any]:
        """Values of parameters by name, of all where none is named."""
        self.send(op="getParameters", parameterNames=list(names), id="get")
        return self._values("get")

    def set_parameters(self, **values: Any) -> dict[str, Any]:
        """Set parameters, named NODE__KEY; their values then."""
        wanted = [
            {"name": name.replace("__", "."), "value": value} for name, value in values.items()
        ]
        self.send(op="setParameters", parameters=wanted, id="set")
        return self._values("set")

    def _values(self, number: str) -> dict[str, Any]:
        while True:
            found = self.until("parameterValues")
            if found.get("id") == number:
                return {one["name"]: one.get("value") for one in found["parameters"]}


def fields_of(payload: bytes) -> dict[int, list[Any]]:
    """Values of the fields of a protobuf message, by number: bytes, integers or 8-byte numbers."""
    found: dict[int, list[Any]] = {}
    at = 0
    while at < len(payload):
        key, at = _varint(payload, at)
        value: Any
        match key & 7:
            case 0:
                value, at = _varint(payload, at)
            case 1:
                (value,), at = struct.unpack_from("<d", payload, at), at + 8
            case 2:
                size, at = _varint(payload, at)
                value, at = payload[at : at + size], at + size
            case 5:
                value, at = payload[at : at + 4], at + 4
            case kind:
                raise ValueError(f"wire type {kind}")
        found.setdefault(key >> 3, []).append(value)
    return found


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def pixels(payload: bytes) -> npt.NDArray[np.float32]:
    """Pixels of a foxglove.RawImage in 32FC1. Its fields: timestamp 1, width 2, height 3,
    encoding 4, step 5, data 6, frame_id 7 (fixed32 width, height, step)."""
    found = fields_of(payload)
    width, height, step = (int.from_bytes(found[k][0], "little") for k in (2, 3, 5))
    assert found[4] == [b"32FC1"]
    assert step == 4 * width
    return np.frombuffer(found[6][0], "<f4").reshape(height, width)
