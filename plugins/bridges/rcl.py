"""Topics of ROS 2 by rclpy (ros2/rclpy, Jazzy), with messages of ready made CDR; as `dds`."""

import importlib
import os
from collections import deque
from itertools import islice
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import SubscriptionEventCallbacks

from sparseskin.nodes.errors import SettingsError

from .endpoints import Reader, Writer


class Member:
    """A node of ROS 2 in a domain; `where` it listens, in words."""

    def __init__(self, domain: int, interface: str, name: str) -> None:
        if interface not in ("", "lo"):
            raise SettingsError(
                f"interface: {interface[:40]!r} is not allowed with rclpy (allowed: 'lo', ''); "
                "another is stated by the configuration of its DDS"
            )
        if interface and os.environ.get("ROS_DISTRO") == "humble":
            os.environ["ROS_LOCALHOST_ONLY"] = "1"
        elif interface:
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        # A context of its own: the process may use rclpy for other nodes.
        self._context = Context()
        rclpy.init(
            args=[],
            context=self._context,
            domain_id=domain,
        )
        # Arguments and parameters of the user's launch file are not for this node.
        options = dict.fromkeys(
            ("use_global_arguments", "enable_rosout", "start_parameter_services"), False
        )
        # rclpy's own services are not needed.
        unserved = Parameter("start_type_description_service", value=False)
        self._node = rclpy.create_node(
            name,
            context=self._context,
            parameter_overrides=[unserved],
            **options,
        )
        # Callbacks run in `take` alone, so that no lock is needed.
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.where = f"ROS domain {domain} by {interface or 'the interfaces of rclpy'}"

    def writer(self, topic: str, kind: str, depth: int, reliable: bool) -> Writer:
        """A writer of messages of a type, as "sensor_msgs/msg/Image"."""
        quality = _quality(depth, reliable)
        publisher = self._node.create_publisher(_message_type(kind), topic, quality)

        # rclpy does not report a message that it drops.
        def write(data: bytes) -> bool:
            publisher.publish(data)
            return True

        return Writer(publisher.get_subscription_count, write)

    def reader(self, topic: str, kind: str, depth: int, reliable: bool) -> Reader:
        """A reader of these messages."""
        waiting = deque[bytes](maxlen=depth)
        # The status counts all that were lost so far: the last one is enough.
        lost = deque[Any](maxlen=1)

        # rclpy asks for the signatures of both, which methods of a deque do not have.
        def arrived(data: bytes) -> None:
            waiting.append(data)

        def were_lost(event: Any) -> None:
            lost.append(event)

        self._node.create_subscription(
            _message_type(kind),
            topic,
            arrived,
            _quality(depth, reliable),
            event_callbacks=SubscriptionEventCallbacks(message_lost=were_lost),
            # Messages stay in CDR, which the decoder here reads.
            raw=True,
        )

        def take(wait_s: float, n: int) -> list[bytes]:
            # Each call of spin_once runs one callback, or none where nothing has come.
            n_before = -1
            while n_before < len(waiting) < n:
                n_before = len(waiting)
                # Only the first message is waited for.
                self._executor.spin_once(timeout_sec=0 if n_before else wait_s)
            return [waiting.popleft() for _ in islice(range(n), len(waiting))]

        return Reader(take, lambda: lost[0].total_count if lost else 0)

    def publications(self) -> dict[str, tuple[str, bool]]:
        """Type of the messages on each topic, and True if they are sent reliably."""
        publications = {}
        for topic, _ in self._node.get_topic_names_and_types():
            for info in self._node.get_publishers_info_by_topic(topic):
                reliable = info.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT
                publications[topic] = (info.topic_type, reliable)
        return publications

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


def _quality(depth: int, reliable: bool) -> Any:
    policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=depth, reliability=policy)


def _message_type(kind: str) -> Any:
    package, _, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError as error:
        raise SettingsError(
            f"{kind} needs the ROS package {package}: {error}"
        ) from error
