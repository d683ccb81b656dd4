"""The bridge `ros2`: publishes forces and contacts of patches as messages of ROS 2."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from sparseskin.messages import Contacts, Message, SkinState, topic_of
from sparseskin.nodes.node import Context
from sparseskin.nodes.settings import setting

from . import cdr, topics
from .base import Bridge, BridgeSettings, Map, check_words, point_columns

KINDS = {
    "image": ("", cdr.IMAGE),
    "points": ("/points", cdr.CLOUD),
    "array": ("/array", cdr.ARRAY),
    "wrench": ("/wrench", cdr.WRENCH),
    "markers": ("/markers", cdr.MARKERS),
}
"""Ending of the topic of each kind of message, and its type."""
OF_MAPS, OF_CONTACTS = ("image", "points", "array"), ("array", "wrench", "markers")


@dataclass(frozen=True)
class Ros2Settings(BridgeSettings):
    """Settings of the bridge `ros2`."""

    messages: tuple[str, ...] = setting(
        tuple(KINDS),
        "image: sensor_msgs/Image on /PATCH/MAP; points: sensor_msgs/PointCloud2 on "
        "/PATCH/MAP/points; array: std_msgs/Float32MultiArray on /PATCH/MAP/array; of contacts: "
        "array, wrench: geometry_msgs/WrenchStamped, markers: visualization_msgs/MarkerArray",
    )
    domain: int | None = setting(
        None, "DDS domain; not stated: ROS_DOMAIN_ID, or 0", low=0, high=232
    )
    interface: str | None = setting(
        None,
        'network interface; "lo": this host alone; "": as CYCLONEDDS_URI has it; not stated: as '
        "ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_LOCALHOST_ONLY have it",
    )
    history: int = setting(10, "samples of a topic kept for readers", low=1, high=1000)
    reliable: bool = setting(True, "send again what a reader has missed, as far as it is kept")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_words("messages", self.messages, KINDS)

    def check(self) -> None:
        topics.check("type ros2")


class Ros2Bridge(Bridge[Ros2Settings]):
    """Publishes each map on a topic; one that nobody reads costs nothing.

    A reader gets the last `history` samples of each topic; where it is further behind, the oldest
    are dropped by DDS, which tells that reader (its status "sample lost").
    """

    HELP = "publish a running graph to ROS 2"
    Settings = Ros2Settings

    def __init__(self, settings: Ros2Settings, context: Context) -> None:
        super().__init__(settings, context)
        settings.check()
        self._member = topics.join(settings.domain, settings.interface, context.name)
        self._writers: dict[str, Any] = {}
        self._announced: set[str] = set()

    def start(self) -> Iterable[Message]:
        for patch in self.settings.patches:
            self._announce(patch)
        self.context.log(f"ros2: {self.where()}")
        if not self.where().endswith(" by lo"):
            self.context.log("ros2: whoever reaches that network can read the graph")
        return ()

    def _announce(self, patch: str) -> None:
        """Make the writers of a patch; those of a batch come with their first frame."""
        settings = self.settings
        quality = settings.history, settings.reliable
        kinds_of = dict.fromkeys(settings.maps, OF_MAPS) | {Contacts.schema: OF_CONTACTS}
        self._announced.add(patch)
        for schema, kinds in kinds_of.items():
            topic = topic_of(patch, schema)
            for kind in (kind for kind in kinds if kind in settings.messages):
                ending, of = KINDS[kind]
                self._writers[f"{kind} {topic}"] = self._member.writer(topic + ending, of, *quality)

    def where(self) -> str:
        return self._member.where

    def send(self, message: Map, skin: SkinState) -> None:
        stamp, patch, forces = _time(message), message.patch, message.forces[0]

        def points() -> bytes:
            return cdr.cloud(stamp, patch, point_columns(skin, {"force": forces}))

        self._write("image", message, lambda: cdr.image(stamp, patch, forces))
        self._write("points", message, points)
        self._write("array", message, lambda: cdr.array(forces))

    def send_contacts(self, message: Contacts, skin: SkinState) -> None:
        stamp = _time(message)
        self._write("array", message, lambda: cdr.contact_array(message))
        self._write("wrench", message, lambda: cdr.contact_wrench(stamp, message))
        self._write("markers", message, lambda: cdr.contact_markers(stamp, message, skin))

    def _write(self, kind: str, message: Message, make: Callable[[], bytes]) -> None:
        """Write what `make` returns, where that kind is wanted and somebody reads it."""
        if message.patch not in self._announced:
            self._announce(message.patch)
        writer = self._writers.get(f"{kind} {message.topic}")
        if writer is not None and writer.is_read():
            self.n_dropped += not writer.write(make())

    def close(self, counts: dict[str, Any]) -> None:
        self._writers.clear()
        self._member.close()


def _time(message: Message) -> tuple[int, int]:
    """Seconds and nanoseconds of its stamp."""
    return divmod(message.stamp_ns, 1_000_000_000)
