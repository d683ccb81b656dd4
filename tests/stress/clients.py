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
    from sparseskin.plugins.bridges.dds import Member
    from sparseskin.plugins.bridges.ros2 import OF_MAPS

    member = Member(int(address), "lo", "stress")
    readers = [
        member.reader(f"{MAP}{ending}", kind, HISTORY, True)
        for ending, kind, _ in OF_MAPS.values()
    ]
    while True:
        for image in readers[0].take(0.1, HISTORY):
            for other in readers[1:]:
                other.take(0, 100)
            yield image


if __name__ == "__main__":
    frames = {"foxglove": foxglove, "ros2": ros2}[sys.argv[1]](sys.argv[2])
    next(frames)
    print("reads", flush=True)
    for _ in frames:
        pass
