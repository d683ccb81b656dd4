"""A tactile skin of a running sparseskin graph as a camera of LeRobot, and its contacts as state.

LeRobot imports this module by its name, and then knows the camera `sparseskin` and the robot
`skinned`, another robot whose state has the contacts of its cameras `sparseskin`, too.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import draccus
import numpy as np
import numpy.typing as npt
from lerobot.cameras import Camera, CameraConfig
from lerobot.robots import Robot, RobotConfig, make_robot_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from sparseskin.launch.run.running import running_graphs
from sparseskin.messages import Reconstruction
from sparseskin.nodes.errors import SparseskinError
from sparseskin.plugins.bridges.contacts import state, state_names
from sparseskin.plugins.bridges.latest import Latest, LatestFrames

FIRST_FRAME_S = 10.0
"""Longest wait for the first frame of a graph, seconds."""
READ_S = 10.0
"""Longest wait of `read` for a frame, seconds; as in cameras of LeRobot."""
MAX_SIDE = 4096
MAX_CONTACTS = 100
"""Most pixels along a side and most contacts; chosen: a number of a file must not fill memory."""


@CameraConfig.register_subclass("sparseskin")
@dataclass(kw_only=True)
class SparseskinCameraConfig(CameraConfig):
    """Settings of the camera.

    Attributes
    ----------
    graph : str, optional
        Name of a running graph of this host; by default the only one.
    patch : str
        Name of the patch.
    f_max : float, optional
        Force of a white pixel, in the skin's unit; by default the range of the skin.
    contacts : int
        Number of contacts in the state of a robot `skinned`; 0: none.
    width, height : int
        Size of the image, pixels, at least that of the patch: a taxel is a rectangle of one grey.
    fps : int
        Rate at which LeRobot reads, which the graph does not follow.
    """

    graph: str | None = None
    patch: str = "skin"
    f_max: float | None = None
    contacts: int = 0
    width: int | None = 128
    height: int | None = 128
    fps: int | None = 30

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            _check(name, getattr(self, name), 1, MAX_SIDE)
        _check("contacts", self.contacts, 0, MAX_CONTACTS)
        if self.f_max is not None and not 0 < self.f_max < float("inf"):
            raise ValueError(f"f_max: {self.f_max} is not above 0")


class SparseskinCamera(Camera):
    """The reconstructions of a patch as grey images, (height, width, 3) of uint8: black is no
    force, white `f_max` or more. The graph runs before the camera is connected.
    """

    def __init__(self, config: SparseskinCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self._frames: LatestFrames | None = None
        self._shown: Latest | None = None

    def __str__(self) -> str:
        return f"SparseskinCamera({self.config.patch})"

    @property
    def is_connected(self) -> bool:
        return self._frames is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """The patches of all graphs that run on this host."""
        return [
            {
                "type": "sparseskin",
                "id": topic.split("/")[1],
                "graph": graph.label,
            }
            for graph in running_graphs()
            for topic in graph.writers()
            if topic.endswith(f"/{Reconstruction.schema}")
        ]

    def connect(self, warmup: bool = True) -> None:
        """Read the graph from now on; with `warmup`, wait for its first frame.

        Raises ConnectionError if there is no such graph or patch, no frame comes, or the image has
        fewer pixels than the patch taxels.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is already connected")
        config = self.config
        try:
            self._frames = LatestFrames(config.graph, config.patch, config.contacts > 0)
        except SparseskinError as error:
            raise ConnectionError(f"{self}: {error}") from error
        if warmup:
            try:
                self._image(self._next(0, FIRST_FRAME_S))
            except (ConnectionError, TimeoutError) as error:
                self.disconnect()
                raise ConnectionError(str(error)) from error

    def read(self) -> npt.NDArray[np.uint8]:
        """The next frame that has not been read; raises TimeoutError after 10 s."""
        return self.async_read(1e3 * READ_S)

    def async_read(self, timeout_ms: float = 200) -> npt.NDArray[np.uint8]:
        """The newest frame, if it has not been read, or the next one; raises TimeoutError."""
        # Numbers of frames begin at 1.
        number = 0
        if self._shown is not None:
            number = self._shown.number
        return self._show(self._next(number, timeout_ms / 1e3))

    def read_latest(self, max_age_ms: int = 500) -> npt.NDArray[np.uint8]:
        """The newest frame, at once, read before or not; raises TimeoutError if it came earlier
        than `max_age_ms` ago.
        """
        latest = self._next(0, 0.0)
        age_ms = (time.monotonic() - latest.at_s) * 1e3
        if age_ms > max_age_ms:
            raise TimeoutError(f"{self}: the newest frame came {age_ms:.0f} ms ago")
        return self._show(latest)

    def state(self) -> list[float]:
        """The numbers of the strongest contacts of the frame that was read last."""
        if self._shown is None or self._shown.contacts is None:
            raise DeviceNotConnectedError(f"{self}: no frame with contacts was read")
        numbers = state(self._shown.contacts, self.config.contacts)
        return [float(number) for number in numbers]

    def disconnect(self) -> None:
        """Stop reading."""
        if self._frames is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        self._frames.close()
        self._frames = None
        self._shown = None

    def _next(self, after: int, timeout_s: float) -> Latest:
        if self._frames is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        try:
            latest = self._frames.newest(after, timeout_s)
        except SparseskinError as error:
            raise ConnectionError(f"{self}: {error}") from error
        if latest is None:
            raise TimeoutError(f"{self}: no frame came for {timeout_s:g} s")
        return latest

    def _show(self, latest: Latest) -> npt.NDArray[np.uint8]:
        image = self._image(latest)
        self._shown = latest
        return image

    def _image(self, latest: Latest) -> npt.NDArray[np.uint8]:
        forces = latest.frame.forces[0]
        n_rows, n_cols = forces.shape
        height = self.config.height or 0
        width = self.config.width or 0
        if height < n_rows or width < n_cols:
            raise ConnectionError(
                f"{self}: height and width are {(height, width)}, less than the "
                f"{forces.shape} taxels"
            )
        f_max = self.config.f_max or latest.skin.f_max
        grey = np.rint(np.clip(forces * (255 / f_max), 0, 255)).astype(np.uint8)

        # Each pixel shows the taxel under it: nothing is smoothed.
        rows = np.arange(height) * n_rows // height
        cols = np.arange(width) * n_cols // width
        large = grey[np.ix_(rows, cols)]
        return np.repeat(large[:, :, np.newaxis], 3, axis=2)


@RobotConfig.register_subclass("skinned")
@dataclass(kw_only=True)
class SkinnedRobotConfig(RobotConfig):
    """Settings of a robot with skins: `base` has those of the robot, its `type` and cameras
    included. It is no `RobotConfig`, whose choices have this one again, without end.
    """

    base: dict[str, Any]


class SkinnedRobot(Robot):
    """Another robot, whose observations have the contacts of its cameras `sparseskin`, too, as
    numbers CAMERA.trusted, CAMERA.contact_1.total ...
    """

    config_class = SkinnedRobotConfig
    name = "skinned"

    def __init__(self, config: SkinnedRobotConfig) -> None:
        # Not that of `Robot`, which makes folders for a calibration: all that is the base's.
        self.config = config
        self.base = make_robot_from_config(draccus.decode(RobotConfig, config.base))
        self.robot_type = self.name
        self._skins: dict[str, SparseskinCamera] = {}
        for key, camera in self.base.cameras.items():
            if isinstance(camera, SparseskinCamera) and camera.config.contacts:
                self._skins[key] = camera
        if not self._skins:
            raise ValueError(
                "base.cameras: none is of type sparseskin with contacts above 0"
            )

    # All that is not of this class is the base's: LeRobot reads attributes that robots add.
    def __getattr__(self, name: str) -> Any:
        return getattr(self.__dict__["base"], name)

    @property
    def observation_features(self) -> dict[str, Any]:
        names = [name for key in self._skins for name in self._names(key)]
        return {**self.base.observation_features, **dict.fromkeys(names, float)}

    @property
    def action_features(self) -> dict[str, Any]:
        features: dict[str, Any] = self.base.action_features
        return features

    @property
    def is_connected(self) -> bool:
        return bool(self.base.is_connected)

    def connect(self, calibrate: bool = True) -> None:
        self.base.connect(calibrate)

    @property
    def is_calibrated(self) -> bool:
        return bool(self.base.is_calibrated)

    def calibrate(self) -> None:
        self.base.calibrate()

    def configure(self) -> None:
        self.base.configure()

    def get_observation(self) -> dict[str, Any]:
        observation: dict[str, Any] = self.base.get_observation()
        # The base has read its cameras: contacts are those of the same frames.
        for key, camera in self._skins.items():
            names = self._names(key)
            observation |= dict(zip(names, camera.state(), strict=True))
        return observation

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        action_sent: dict[str, Any] = self.base.send_action(action)
        return action_sent

    def disconnect(self) -> None:
        self.base.disconnect()

    def _names(self, key: str) -> list[str]:
        return state_names(key, self._skins[key].config.contacts)


def _check(name: str, value: int | None, low: int, high: int) -> None:
    if value is None or not low <= value <= high:
        raise ValueError(f"{name}: {value} is outside {low}..{high}")
