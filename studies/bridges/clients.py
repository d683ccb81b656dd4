"""A tool at the other end of a bridge: python -m sparseskin.studies.bridges.clients KIND ADDRESS.

It reads all that is sent and does nothing with it; a line on stdout once it has read the first.
"""

from __future__ import annotations

import json
import sys
from typing import Any

MAP = "/skin/reconstruction"


def foxglove(address: str) -> None:
    """Subscribe to image, grid and figures of the reconstruction."""
    from websockets.sync.client import connect

    options: dict[str, Any] = {"subprotocols": ["foxglove.sdk.v1"], "max_size": None}
    with connect(address, **options) as socket:
        channels: dict[str, int] = {}
        wanted = [MAP, f"{MAP}/grid", f"{MAP}/figures"]
        while not set(wanted) <= channels.keys():
            found = json.loads(socket.recv())
            channels |= {one["topic"]: one["id"] for one in found.get("channels", ())}
        asked = [{"id": k, "channelId": channels[name]} for k, name in enumerate(wanted, 1)]
        socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        while not isinstance(socket.recv(), bytes):
            pass
        print("reads", flush=True)
        while True:
            socket.recv()


def ros2(address: str) -> None:
    """Subscribe to image, points and array of the reconstruction, on a DDS domain."""
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    from sparseskin.nodes.bridges import dds

    member = dds.participant(int(address), "lo")
    types: dict[str, Any] = {
        "": dds.Image,
        "/points": dds.PointCloud2,
        "/array": dds.Float32MultiArray,
    }
    readers: list[Any] = [
        DataReader(member, Topic(member, f"rt{MAP}{ending}", cls), qos=dds.quality(10))
        for ending, cls in types.items()
    ]
    for _ in readers[0].take_iter(timeout=duration(seconds=60)):
        break
    print("reads", flush=True)
    while True:
        for _ in readers[0].take_iter(timeout=duration(milliseconds=100)):
            for other in readers[1:]:
                other.take(N=100)


def lerobot(address: str) -> None:
    """Subscribe as LeRobot's ZMQ camera does."""
    import zmq

    socket: Any = zmq.Context().socket(zmq.SUB)
    socket.setsockopt_string(zmq.SUBSCRIBE, "")
    socket.setsockopt(zmq.CONFLATE, True)
    socket.connect(address)
    json.loads(socket.recv_string())
    print("reads", flush=True)
    while True:
        json.loads(socket.recv_string())


if __name__ == "__main__":
    {"foxglove": foxglove, "ros2": ros2, "lerobot": lerobot}[sys.argv[1]](sys.argv[2])
