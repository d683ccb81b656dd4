"""An arm of one joint and its leader, as LeRobot finds devices of other packages."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.cameras import CameraConfig
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

JOINT = {"joint.pos": float}


class _Device:
    """What an arm and its leader share: nothing to calibrate."""

    is_connected = False
    is_calibrated = True
    action_features = JOINT

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def disconnect(self) -> None:
        self.is_connected = False


@RobotConfig.register_subclass("one_joint")
@dataclass(kw_only=True)
class OneJointConfig(RobotConfig):
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class OneJoint(_Device, Robot):
    config_class = OneJointConfig
    name = "one_joint"

    def __init__(self, config: OneJointConfig) -> None:
        super().__init__(config)
        self.cameras = make_cameras_from_configs(config.cameras)

    @property
    def observation_features(self) -> dict[str, Any]:
        return JOINT | {
            key: (one.height, one.width, 3) for key, one in self.cameras.items()
        }

    def connect(self, calibrate: bool = True) -> None:
        for one in self.cameras.values():
            one.connect()
        self.is_connected = True

    def get_observation(self) -> dict[str, Any]:
        return {"joint.pos": 0.5} | {
            key: one.read_latest() for key, one in self.cameras.items()
        }

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return action

    def disconnect(self) -> None:
        for one in self.cameras.values():
            one.disconnect()
        super().disconnect()


@TeleoperatorConfig.register_subclass("one_joint_leader")
@dataclass(kw_only=True)
class OneJointLeaderConfig(TeleoperatorConfig):
    pass


class OneJointLeader(_Device, Teleoperator):
    config_class = OneJointLeaderConfig
    name = "one_joint_leader"
    feedback_features: dict[str, Any] = {}  # noqa: RUF012

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def get_action(self) -> dict[str, float]:
        return {"joint.pos": 0.25}

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...
