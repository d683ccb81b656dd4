"""Topics of ROS 2 by rclpy, with messages whose CDR is ready made; as `dds`.

Source of the interface: ros2/rclpy, `node.py`, `publisher.py`, `executors.py`, as of Jazzy.
"""

from __future__ import annotations

import importlib
import os
import re
from collections import deque
from itertools import islice
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy

from sparseskin.nodes.errors import SettingsError


class Member:
    """A node of ROS 2 in a domain; `where` it listens, in words."""

    def __init__(self, domain: int, interface: str, name: str) -> None:
        if interface not in ("", "lo"):
            raise SettingsError(
                f"interface: {interface[:40]!r} is not allowed with rclpy (allowed: 'lo', ''); "
                "another is stated by the configuration of its DDS"
            )
        if interface:
            os.environ |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOCALHOST_ONLY": "1"}
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        options = dict.fromkeys(
            ("use_global_arguments", "enable_rosout", "start_parameter_services"), False
        )
        name = re.sub(r"\W", "_", f"sparseskin_{name}", flags=re.ASCII)
        self._node = rclpy.create_node(name, context=self._context, **options)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.where = f"ROS domain {domain} by {interface or 'the interfaces of rclpy'}"

    def writer(self, topic: str, kind: str, depth: int, reliable: bool) -> Writer:
        """A writer of messages of a type, as "sensor_msgs/msg/Image"."""
        quality = _quality(depth, reliable)
        return Writer(self._node.create_publisher(_message_type(kind), topic, quality))

    def reader(self, topic: str, kind: str, depth: int, reliable: bool) -> Reader:
        """A reader of these messages."""
        held = deque[bytes](maxlen=depth)
        quality = _quality(depth, reliable)
        self._node.create_subscription(_message_type(kind), topic, held.append, quality, raw=True)
        return Reader(self._executor, held)

    def publications(self) -> dict[str, tuple[str, bool]]:
        """Type of the messages on each topic, and True if they are sent reliably."""
        return {
            topic: (info.topic_type, info.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT)
            for topic, _ in self._node.get_topic_names_and_types()
            for info in self._node.get_publishers_info_by_topic(topic)
        }

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


class Writer:
    """A publisher."""

    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher

    def is_read(self) -> bool:
        """True if somebody reads the topic."""
        return bool(self._publisher.get_subscription_count())

    def write(self, data: bytes) -> bool:
        """Publish a message in CDR. Its return value False: a reader was behind, it is dropped."""
        self._publisher.publish(data)
        return True


class Reader:
    """Messages of a subscription, in CDR. Those that were lost on the way are not known."""

    n_lost = 0

    def __init__(self, executor: Any, held: deque[bytes]) -> None:
        self._executor, self._held = executor, held

    def take(self, wait_s: float, n: int) -> list[bytes]:
        """At most n messages, after a wait for the first one."""
        before = -1
        while before < len(self._held) < n:
            before = len(self._held)
            self._executor.spin_once(timeout_sec=0 if before else wait_s)
        return [self._held.popleft() for _ in islice(range(n), len(self._held))]


def _quality(depth: int, reliable: bool) -> Any:
    policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=depth, reliability=policy)


def _message_type(kind: str) -> Any:
    package, _, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError as error:
        raise SettingsError(f"{kind} needs the ROS package {package}: {error}") from error
