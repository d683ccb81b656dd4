"""The bridge `ros2`: publishes the forces of patches as messages of ROS 2, without ROS."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from sparseskin.messages import Message, SkinState, topic_of
from sparseskin.nodes.node import Context
from sparseskin.nodes.settings import setting

from . import cdr
from .base import Bridge, BridgeSettings, Map, check_installed, check_words, point_columns

KINDS = {"image": ("", cdr.IMAGE), "points": ("/points", cdr.CLOUD), "array": ("/array", cdr.ARRAY)}
"""Ending of the topic of each kind of message, and its type."""


@dataclass(frozen=True)
class Ros2Settings(BridgeSettings):
    """Settings of the bridge `ros2`."""

    messages: tuple[str, ...] = setting(
        tuple(KINDS),
        "image: sensor_msgs/Image on /PATCH/MAP; points: sensor_msgs/PointCloud2 on "
        "/PATCH/MAP/points; array: std_msgs/Float32MultiArray on /PATCH/MAP/array",
    )
    domain: int = setting(0, "DDS domain, ROS_DOMAIN_ID of the readers", low=0, high=232)
    interface: str = setting(
        "lo", 'network interface; "lo": this host alone; "": as CYCLONEDDS_URI has it'
    )
    history: int = setting(10, "samples of a topic kept for readers", low=1, high=1000)
    reliable: bool = setting(True, "send again what a reader has missed, as far as it is kept")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_words("messages", self.messages, KINDS)

    def check(self) -> None:
        check_installed("type ros2", "ros2", "cyclonedds", "rosbags")


class Ros2Bridge(Bridge[Ros2Settings]):
    """Publishes each map on DDS; a topic that nobody reads costs nothing.

    A reader gets the last `history` samples of each topic; where it is further behind, the oldest
    are dropped by DDS, which tells that reader (its status "sample lost").
    """

    HELP = "publish a running graph to ROS 2"
    Settings = Ros2Settings

    def __init__(self, settings: Ros2Settings, context: Context) -> None:
        super().__init__(settings, context)
        settings.check()
        from . import dds

        self._dds = dds
        self._participant = dds.participant(settings.domain, settings.interface)
        self._writers: dict[str, Any] = {}

    def start(self) -> Iterable[Message]:
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        dds, settings = self._dds, self.settings
        quality = dds.quality(settings.history, settings.reliable)
        for patch in settings.patches:
            for schema in settings.maps:
                for kind in settings.messages:
                    ending, of = KINDS[kind]
                    name = dds.dds_name(topic_of(patch, schema) + ending)
                    topic = Topic(self._participant, name, dds.message_type(of))
                    self._writers[f"{kind} {topic_of(patch, schema)}"] = DataWriter(
                        self._participant, topic, qos=quality
                    )
        self.context.log(f"ros2: {self.where()}")
        return ()

    def where(self) -> str:
        by = f" by {self.settings.interface}" if self.settings.interface else ""
        return f"DDS domain {self.settings.domain}{by}"

    def send(self, message: Map, skin: SkinState) -> None:
        from cyclonedds.core import DDSException

        stamp = divmod(message.stamp_ns, 1_000_000_000)
        for kind in self.settings.messages:
            writer = self._writers[f"{kind} {message.topic}"]
            if not writer.get_matched_subscriptions():
                continue
            if kind == "image":
                made = cdr.image(stamp, message.patch, message.forces[0])
            elif kind == "array":
                made = cdr.array(message.forces[0])
            else:
                columns = point_columns(skin, {"force": message.forces[0]})
                made = cdr.cloud(stamp, message.patch, columns)
            try:
                writer.write(self._dds.ready(writer.topic.data_type, made))
            except DDSException:  # a reader is behind
                self.n_dropped += 1

    def close(self, counts: dict[str, Any]) -> None:
        self._writers.clear()
