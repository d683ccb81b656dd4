"""Bridge and source of ROS 2 by rclpy: the real one in a terminal with ROS 2, else a stand-in with
those of its signatures that are used, which hands bytes from publisher to subscription.
"""

import inspect
import os
import sys
from collections import deque
from importlib.util import find_spec
from itertools import islice
from threading import Thread
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed")
from bags import skin_state
from conftest import wait_until

from sparseskin.messages import Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.node import Context
from sparseskin.plugins.bridges import topics
from sparseskin.plugins.bridges.ros2 import Ros2Bridge, Ros2Settings
from sparseskin.plugins.bridges.ros2_source import frames

DOMAIN = 100 + hash(sys.executable + str(os.getcwd())) % 100


class Node:
    topics = None
    """Type, quality, messages and callback of each topic."""

    def create_publisher(self, msg_type, topic, qos_profile):
        held = deque[bytes]()
        self.topics[topic] = made = SimpleNamespace(
            topic_type=msg_type.__doc__,
            qos_profile=qos_profile,
            held=held,
            callback=None,
        )
        return SimpleNamespace(
            publish=held.append,
            get_subscription_count=lambda: int(made.callback is not None),
        )

    def create_subscription(
        self, msg_type, topic, callback, qos_profile, *, event_callbacks, raw
    ):
        inspect.signature(callback).bind(b"")
        assert raw
        assert msg_type.__doc__ == self.topics[topic].topic_type
        assert qos_profile.reliability == self.topics[topic].qos_profile.reliability
        self.topics[topic].callback = callback

    def get_topic_names_and_types(self):
        return [(topic, [one.topic_type]) for topic, one in self.topics.items()]

    def get_publishers_info_by_topic(self, topic):
        return [self.topics[topic]]

    def destroy_node(self): ...


class Executor:
    def __init__(self, *, context): ...

    def add_node(self, node): ...

    def spin_once(self, timeout_sec=None):
        for one in Node.topics.values():
            if one.held:
                one.callback(one.held.popleft())

    def shutdown(self): ...


@pytest.fixture(autouse=True)
def ros(monkeypatch):
    """A stand-in for rclpy, where it is not installed."""
    monkeypatch.setattr(os, "environ", os.environ.copy())
    monkeypatch.setitem(os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if find_spec("rclpy"):
        return

    def create_node(node_name, *, context, parameter_overrides, **flags):
        assert node_name.isidentifier()
        assert flags.keys() == {
            "use_global_arguments",
            "enable_rosout",
            "start_parameter_services",
        }
        return Node()

    array = SimpleNamespace(__doc__="std_msgs/msg/Float32MultiArray")
    modules = dict.fromkeys(
        ("rclpy.context", "rclpy.parameter", "rclpy.subscription", "std_msgs"),
        MagicMock(),
    ) | {
        "rclpy": SimpleNamespace(
            init=lambda *, args, context, domain_id: None, create_node=create_node
        ),
        "rclpy.executors": SimpleNamespace(SingleThreadedExecutor=Executor),
        "rclpy.qos": SimpleNamespace(
            QoSProfile=SimpleNamespace, ReliabilityPolicy=MagicMock(BEST_EFFORT=2)
        ),
        "std_msgs.msg": SimpleNamespace(Float32MultiArray=array),
    }
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "sparseskin.plugins.bridges.rcl", raising=False)
    monkeypatch.setattr(Node, "topics", {})


@pytest.mark.parametrize("reliable", [True, False])
def test_frames_go_from_the_bridge_to_the_source_by_rclpy(reliable):
    settings = Ros2Settings(
        domain=DOMAIN, messages=("array",), reliable=reliable, history=100
    )
    bridge = Ros2Bridge(settings, Context("ros2-1", ManualClock(0)))
    list(bridge.start())
    received = []
    found = frames(f"ros2:/skin/taxels/array?domain={DOMAIN}&interface=lo&timeout_s=60")
    reading = Thread(target=lambda: received.extend(islice(found, 20)))
    reading.start()
    wait_until(bridge._writers["array /skin/taxels"].readers, "the source")
    list(bridge.step(skin_state(n_rows=3, n_cols=4, mask=None)))
    sent = [np.full((1, 3, 4), k / 8, np.float32) for k in range(20)]
    for k, forces in enumerate(sent):
        list(bridge.step(Taxels(stamp_ns=k + 1, patch="skin", forces=forces)))
    reading.join()
    assert [forces.tolist() for _, forces in received] == [
        one[0].tolist() for one in sent
    ]
    bridge.close({})


def test_rclpy_has_no_other_interface_and_its_absence_is_one_line(monkeypatch):
    with pytest.raises(
        SettingsError, match=r"'eth0' is not allowed with rclpy \(allowed: 'lo'"
    ):
        topics.join(DOMAIN, "eth0", "a")
    member = topics.join(DOMAIN, "", "a")
    with pytest.raises(
        SettingsError, match="my_msgs/msg/Touch needs the ROS package my_msgs"
    ):
        member.writer("/a", "my_msgs/msg/Touch", 1, True)
    member.close()
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.setattr("sparseskin.plugins.bridges.base.find_spec", lambda _: None)
    with pytest.raises(
        SettingsError, match=r"source /opt/ros/.*pip install 'sparseskin\[ros2\]'"
    ):
        topics.check("type ros2")
