"""A tool at the other end of a bridge: python -m stress.clients KIND ADDRESS [N].

It reads all that is sent; a line on stdout once it has read the first. With N, it ends with the
frame whose stamp is N ms, and prints how many frames of 1 to N ms it has read.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator
from typing import Any

MAP = "/skin/reconstruction"
HISTORY = 1000
"""Samples that DDS keeps for this reader: more than come while it does not run."""
CDR_HEAD = 4
_STAMP = struct.Struct("<iI")  # of a header of ROS: seconds, nanoseconds


def foxglove(address: str) -> Iterator[int]:
    """Subscribe to image, grid and figures of the reconstruction; yield stamps of images, ns."""
    from foxglove_client import FoxgloveClient

    with FoxgloveClient(address) as client:
        wanted = [MAP, f"{MAP}/grid", f"{MAP}/figures"]
        client.wait_for_channels(*wanted)
        client.subscribe(*wanted)
        while True:
            if (got := client.data()).topic == MAP:
                yield got.log_time_ns


def ros2(address: str) -> Iterator[int]:
    """Subscribe to image, points and array of the reconstruction, on a DDS domain; yield the stamps
    of images, ns.
    """
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    from sparseskin.plugins.bridges import dds
    from sparseskin.plugins.bridges.ros2 import KINDS

    member = dds.participant(int(address), "lo")
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
            sec, nanosec = _STAMP.unpack_from(image.cdr, CDR_HEAD)
            yield 1_000_000_000 * sec + nanosec


def main(kind: str, address: str, last_ms: int | None = None) -> None:
    """Read until the frame `last_ms`, or for ever."""
    stamps = {"foxglove": foxglove, "ros2": ros2}[kind](address)
    next(stamps)
    print("reads", flush=True)
    found: set[int] = set()
    for stamp_ns in stamps:
        found.add(stamp_ns // 1_000_000)
        if stamp_ns // 1_000_000 == last_ms:
            print(sum(1 <= ms <= last_ms for ms in found), flush=True)
            return
        if last_ms is None:
            found.clear()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else None)
