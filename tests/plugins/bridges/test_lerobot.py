"""The bridge to LeRobot, read as its ZMQ camera reads."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zmq
from bags import skin_state
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages import Reconstruction
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.node import Context
from sparseskin.plugins.bridges.lerobot import LeRobotBridge, LeRobotSettings
from sparseskin.plugins.bridges.png import greys, png

ROWS, COLS = 6, 9
SKIN = skin_state(n_rows=ROWS, n_cols=COLS, pitch_m=None, mask=None)


def frame(stamp_ns: int) -> Reconstruction:
    forces = np.random.default_rng(stamp_ns).random((ROWS, COLS)).astype(np.float32) * 3
    return Reconstruction(
        stamp_ns=stamp_ns, patch="skin", forces=forces, phi="0" * 16, iterations=(1,),
        residual=(0.0,), solve_ns=(0,), done_ns=0,
    )  # fmt: skip


def decoded(data: bytes) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Pixels of a PNG by a library that is not ours."""
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    return np.asarray(image.open(io.BytesIO(data)))


class Camera:
    """The receiving half of lerobot.cameras.zmq.ZMQCamera."""

    def __init__(self, endpoint: str) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.setsockopt_string(zmq.SUBSCRIBE, "")
        self._socket.setsockopt(zmq.CONFLATE, True)
        self._socket.connect(endpoint)

    def read(self, name: str, timeout_ms: int) -> tuple[float, bytes] | None:
        if not self._socket.poll(timeout_ms):
            return None
        data = json.loads(self._socket.recv_string())
        return data["timestamps"][name], base64.b64decode(data["images"][name])

    def close(self) -> None:
        self._context.destroy(linger=0)


def made(**settings: Any) -> LeRobotBridge:
    bridge = LeRobotBridge(LeRobotSettings(port=0, **settings), Context("lerobot", ManualClock(0)))
    assert not list(bridge.start())
    return bridge


@pytest.fixture
def bridge() -> Iterator[LeRobotBridge]:
    one = made(rate_hz=0.0, pixels=3)
    yield one
    one.close({})


def test_a_camera_of_lerobot_sees_the_newest_reconstruction(bridge: LeRobotBridge) -> None:
    camera = Camera(bridge.where())
    try:
        list(bridge.step(SKIN))
        for k in range(50):
            message = frame(1_000_000_000 + k)
            got = None
            while got is None or got[0] != message.stamp_ns / 1e9:
                list(bridge.step(message))  # again, until the subscription has arrived
                got = camera.read("skin", 20)
            image = decoded(got[1])
            assert image.shape == (3 * ROWS, 3 * COLS)
            back = image[::3, ::3] * (2.5 / 255)
            assert np.abs(back - np.minimum(message.forces[0], 2.5)).max() <= 2.5 / 510 + 1e-6
    finally:
        camera.close()


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1), st.floats(1e-3, 1e4))
def test_a_png_holds_the_grey_levels_of_the_stated_mapping(
    height: int, width: int, seed: int, full_scale: float
) -> None:
    drawn = np.random.default_rng(seed).uniform(-0.2, 1.2, (height, width)) * full_scale
    forces = drawn.astype(np.float32)
    levels = greys(forces, full_scale)
    assert np.array_equal(decoded(png(levels)), levels)
    assert levels[forces <= 0].sum() == 0
    assert (levels[forces >= full_scale] == 255).all()
    inside = np.clip(forces, 0, full_scale)
    assert np.abs(levels * (full_scale / 255) - inside).max() <= full_scale / 509


def test_frames_between_two_images_are_left_out_and_counted() -> None:
    bridge = made(rate_hz=30.0)
    try:
        list(bridge.step(SKIN))
        for k in range(1000):  # 1 s at 1 kHz
            list(bridge.step(frame(7 + k * 1_000_000)))
        assert bridge.n_sent == 30
        assert bridge.n_between == 970
        list(bridge.step(frame(60 * 1_000_000_000)))  # after a pause, at once
        assert bridge.n_sent == 31
    finally:
        bridge.close({})


def test_a_port_that_is_taken_is_refused(bridge: LeRobotBridge) -> None:
    port = int(bridge.where().rpartition(":")[2])
    with pytest.raises(SettingsError, match=rf"port: cannot bind 127.0.0.1:{port}"):
        LeRobotBridge(LeRobotSettings(port=port), Context("two", ManualClock(0)))
