"""Bridge and source of ROS 2 by rclpy: here a stand-in with those signatures of ros2/rclpy (Jazzy)
that are used, which hands bytes from publisher to subscription within this process. It shows the
calls and the flow of data, no behaviour of ROS 2 itself, which cannot be installed by pip.
"""

import os
import sys
from collections import deque
from itertools import islice
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed")
from bags import skin_state

from sparseskin.messages import Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.node import Context
from sparseskin.plugins.bridges import topics
from sparseskin.plugins.bridges.ros2 import Ros2Bridge, Ros2Settings
from sparseskin.plugins.bridges.ros2_source import frames


class QoSProfile:
    def __init__(self, history=None, depth=None, reliability=None):
        self.depth, self.reliability = depth, reliability


PUBLISHED = {}
"""Type, quality and messages, not yet received, of each topic."""
SUBSCRIBED = {}


class Node:
    def create_publisher(self, msg_type, topic, qos_profile):
        held = deque[bytes]()
        PUBLISHED[topic] = msg_type, qos_profile, held
        return SimpleNamespace(publish=held.append, get_subscription_count=lambda: 1)

    def create_subscription(self, msg_type, topic, callback, qos_profile, *, raw=False):
        assert raw
        assert msg_type is PUBLISHED[topic][0]
        assert qos_profile.reliability == PUBLISHED[topic][1].reliability
        SUBSCRIBED[topic] = callback

    def get_topic_names_and_types(self):
        return [(topic, [found[0].__doc__ or ""]) for topic, found in PUBLISHED.items()]

    def get_publishers_info_by_topic(self, topic):
        msg_type, quality, _ = PUBLISHED[topic]
        return [SimpleNamespace(topic_type=msg_type.__doc__, qos_profile=quality)]

    def destroy_node(self): ...


class Executor:
    def __init__(self, *, context): ...

    def add_node(self, node): ...

    def spin_once(self, timeout_sec=None):
        for topic, callback in SUBSCRIBED.items():
            if held := PUBLISHED[topic][2]:
                callback(held.popleft())

    def shutdown(self): ...


@pytest.fixture
def started(monkeypatch):
    """A stand-in for rclpy; what `init` and `create_node` were called with."""
    calls = []

    def init(*, args, context, domain_id):
        calls.append({"args": args, "domain_id": domain_id})

    def create_node(node_name, *, context, **options):
        calls.append({"node_name": node_name, **options})
        return Node()

    policy = SimpleNamespace(RELIABLE=1, BEST_EFFORT=2)
    of_std = {"Float32MultiArray": type("A", (), {"__doc__": "std_msgs/msg/Float32MultiArray"})}
    made = {
        "rclpy": {"init": init, "create_node": create_node},
        "rclpy.context": {"Context": lambda: SimpleNamespace(try_shutdown=lambda: None)},
        "rclpy.executors": {"SingleThreadedExecutor": Executor},
        "rclpy.qos": {"QoSProfile": QoSProfile, "ReliabilityPolicy": policy},
        "std_msgs": {},
        "std_msgs.msg": of_std,
    }
    for name, held in made.items():
        module = ModuleType(name)
        vars(module).update(held)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "sparseskin.plugins.bridges.rcl", raising=False)
    monkeypatch.setattr(os, "environ", os.environ.copy())
    PUBLISHED.clear()
    SUBSCRIBED.clear()
    return calls


def test_frames_go_from_the_bridge_to_the_source_by_rclpy(started):
    settings = Ros2Settings(domain=7, messages=("array",), reliable=False, maps=("taxels",))
    bridge = Ros2Bridge(settings, Context("ros2-1", ManualClock(0)))
    assert started[0] == {"args": [], "domain_id": 7}
    assert started[1]["node_name"] == "sparseskin_ros2_1"
    assert not started[1]["use_global_arguments"]
    list(bridge.start())
    assert PUBLISHED["/skin/taxels/array"][1].depth == settings.history
    list(bridge.step(skin_state(n_rows=3, n_cols=4, mask=None)))
    sent = [np.full((1, 3, 4), k / 8, np.float32) for k in range(20)]
    for k, forces in enumerate(sent):
        list(bridge.step(Taxels(stamp_ns=k + 1, patch="skin", forces=forces)))
    found = frames("ros2:/skin/taxels/array?domain=7&interface=lo&timeout_s=60")
    received = [forces.tolist() for _, forces in islice(found, 20)]
    assert received == [one[0].tolist() for one in sent]
    assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    bridge.close({})


def test_rclpy_has_no_other_interface_and_its_absence_is_one_line(started, monkeypatch):
    with pytest.raises(SettingsError, match=r"'eth0' is not allowed with rclpy \(allowed: 'lo'"):
        topics.join(0, "eth0", "a")
    with pytest.raises(SettingsError, match="MarkerArray needs the ROS package"):
        topics.join(0, "", "a").writer("/a", "visualization_msgs/msg/MarkerArray", 1, True)
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.setattr("sparseskin.plugins.bridges.base.find_spec", lambda _: None)
    with pytest.raises(SettingsError) as caught:
        topics.check("type ros2")
    assert "source /opt/ros/.../setup.bash" in str(caught.value)
    assert "pip install 'sparseskin[ros2]'" in str(caught.value)
