"""A bridge of another package, found by its entry point: one datagram of JSON for each map."""

import json
import socket
from dataclasses import dataclass

import numpy as np

from sparseskin.messages import Contacts, Reconstruction
from sparseskin.nodes.settings import setting
from sparseskin.plugins.bridges.base import Bridge, BridgeSettings


@dataclass(frozen=True)
class UdpSettings(BridgeSettings):
    """Settings of the bridge, besides `patches`, `maps` and `depth`."""

    host: str = setting("127.0.0.1", "address to send to")
    port: int = setting(5005, "port to send to", low=1, high=65535)


class UdpBridge(Bridge[UdpSettings]):
    """Sends the largest force of each map, and where it is; no receiver is needed."""

    HELP = "send the largest force of each frame as a datagram of JSON"
    EXTRAS = ()  # no contacts: `send` is called with maps alone
    Settings = UdpSettings

    def __init__(self, settings, context):
        super().__init__(settings, context)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def where(self):
        return f"udp://{self.settings.host}:{self.settings.port}"

    def send(self, message, skin):
        assert not isinstance(message, Contacts)
        # Of a batch each patch comes by itself.
        (forces,) = message.forces
        row, col = np.unravel_index(forces.argmax(), forces.shape)
        fields = {
            "patch": message.patch,
            "map": message.schema,
            "stamp_ns": message.stamp_ns,
            "force": float(forces[row, col]),
            "unit": skin.unit,
            "row": int(row),
            "col": int(col),
        }
        if isinstance(message, Reconstruction):
            (fields["reason"],) = message.reason or ("",)
        # A datagram that nobody receives is lost, and no error.
        address = (self.settings.host, self.settings.port)
        self._socket.sendto(json.dumps(fields).encode(), address)

    def close(self, counts):
        self._socket.close()
