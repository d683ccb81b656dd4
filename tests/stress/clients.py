"""A tool at the other end of a bridge: python -m stress.clients KIND ADDRESS.

It reads all that is sent; a line on stdout once it has read the first.
"""

import sys
from collections.abc import Iterator
from typing import Any

MAP = "/skin/reconstruction"
HISTORY = 1000
"""Samples that DDS keeps for this reader: more than come while it does not run."""


def foxglove(address: str) -> Iterator[Any]:
    """Subscribe to image, grid and figures of the reconstruction; yield the images."""
    from foxglove_client import FoxgloveClient

    with FoxgloveClient(address) as client:
        wanted = [MAP, f"{MAP}/grid", f"{MAP}/figures"]
        client.wait_for_channels(*wanted)
        client.subscribe(*wanted)
        while True:
            if (got := client.data()).topic == MAP:
                yield got


def ros2(address: str) -> Iterator[Any]:
    """Subscribe to image, points and array of the reconstruction, on a DDS domain."""
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    from sparseskin.plugins.bridges import dds
    from sparseskin.plugins.bridges.ros2 import KINDS

    member, _ = dds.participant(int(address), "lo")
    readers: list[Any] = [
        DataReader(
            member,
            Topic(member, f"rt{MAP}{ending}", dds.message_type(kind)),
            qos=dds.quality(HISTORY),
        )
        for ending, kind in KINDS.values()
    ]
    while True:
        for image in readers[0].take_iter(timeout=duration(milliseconds=100)):
            for other in readers[1:]:
                other.take(N=100)
            yield image


if __name__ == "__main__":
    frames = {"foxglove": foxglove, "ros2": ros2}[sys.argv[1]](sys.argv[2])
    next(frames)
    print("reads", flush=True)
    for _ in frames:
        pass
