"""The bridge `ros2`: publishes forces and contacts of patches as messages of ROS 2."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from sparseskin.messages import Contacts, Message, SkinState, topic_of
from sparseskin.nodes.node import Context
from sparseskin.nodes.settings import setting

from . import cdr, topics
from .base import Bridge, BridgeSettings, Map, check_words, point_columns

Form = tuple[str, str, Callable[[Any, Any], bytes]]
OF_MAPS: dict[str, Form] = {
    "image": ("", cdr.IMAGE, lambda m, _: cdr.image(_time(m), m.patch, m.forces[0])),
    "points": ("/points", cdr.CLOUD, lambda m, skin: _cloud(m, skin)),
    "array": ("/array", cdr.ARRAY, lambda m, _: cdr.array(m.forces[0])),
}
"""Ending of the topic of each kind of message of a map, its type, and what makes it."""
OF_CONTACTS: dict[str, Form] = {
    "array": ("/array", cdr.ARRAY, lambda m, _: cdr.contact_array(m)),
    "wrench": ("/wrench", cdr.WRENCH, lambda m, _: cdr.contact_wrench(_time(m), m)),
    "markers": (
        "/markers",
        cdr.MARKERS,
        lambda m, skin: cdr.contact_markers(_time(m), m, skin),
    ),
}
KINDS = tuple(OF_MAPS | OF_CONTACTS)


@dataclass(frozen=True)
class Ros2Settings(BridgeSettings):
    """Settings of the bridge `ros2`."""

    messages: tuple[str, ...] = setting(
        KINDS,
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
    reliable: bool = setting(
        True, "send again what a reader has missed, as far as it is kept"
    )

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
        # Tools list the topics as soon as the bridge is there.
        for patch in self.settings.patches:
            self._announce(patch)
        self.context.log(f"ros2: {self.where()}")
        # DDS has no access control: whoever hears it may read and write.
        if not self.where().endswith(" by lo"):
            self.context.log("ros2: whoever reaches that network can read the graph")
        return ()

    def _announce(self, patch: str) -> None:
        """Make the writers of a patch; those of a batch come with their first frame."""
        settings = self.settings
        quality = (settings.history, settings.reliable)
        self._announced.add(patch)
        for schema in (*settings.maps, Contacts.schema):
            topic = topic_of(patch, schema)
            forms = OF_CONTACTS if schema == Contacts.schema else OF_MAPS
            for kind, (ending, message_type, _) in forms.items():
                if kind in settings.messages:
                    writer = self._member.writer(topic + ending, message_type, *quality)
                    self._writers[f"{kind} {topic}"] = writer

    def where(self) -> str:
        return str(self._member.where)

    def send(self, message: Message, skin: SkinState) -> None:
        if message.patch not in self._announced:
            self._announce(message.patch)
        forms = OF_CONTACTS if isinstance(message, Contacts) else OF_MAPS
        for kind, (_, _, make) in forms.items():
            # Kinds that the settings leave out have no writer.
            writer = self._writers.get(f"{kind} {message.topic}")
            # A message that nobody reads is not made.
            if writer is not None and writer.readers():
                self.n_dropped += not writer.write(make(message, skin))

    def close(self, counts: dict[str, Any]) -> None:
        self._writers.clear()
        self._member.close()


def _time(message: Message) -> tuple[int, int]:
    """Seconds and nanoseconds of its stamp."""
    return divmod(message.stamp_ns, 1_000_000_000)


def _cloud(m: Map, skin: SkinState) -> bytes:
    return cdr.cloud(_time(m), m.patch, point_columns(skin, {"force": m.forces[0]}))
