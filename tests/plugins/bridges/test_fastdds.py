"""The bridge to ROS 2 and its source against Fast DDS, by which ROS 2 talks by default."""

import shutil
import subprocess
import sys
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed")
from bags import skin_state
from conftest import wait_until

from sparseskin.messages import Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.node import Context
from sparseskin.plugins.bridges.ros2 import Ros2Bridge, Ros2Settings
from sparseskin.plugins.bridges.ros2_source import frames

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (shutil.which("fastddsgen") and shutil.which("g++")),
        reason="fastddsgen, libfastrtps-dev or g++ are not installed",
    ),
]
SOURCES = Path(__file__).with_name("fastdds")
DOMAIN = 110 + hash(sys.executable + str(Path.cwd())) % 90


@pytest.fixture(autouse=True)
def defaults_of_ros(monkeypatch):
    for name in (
        "ROS_DOMAIN_ID",
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "ROS_LOCALHOST_ONLY",
    ):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="module")
def peer(tmp_path_factory):
    """The program of the other end."""
    folder = tmp_path_factory.mktemp("fastdds")
    for path in SOURCES.iterdir():
        shutil.copy(path, folder)
    program = "peer.cpp Float32MultiArray.cxx Float32MultiArrayPubSubTypes.cxx -o peer"
    for command in (
        ["fastddsgen", "Float32MultiArray.idl"],
        ["g++", "-std=c++14", *program.split(), "-lfastrtps", "-lfastcdr"],
    ):
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return folder / "peer"


@contextmanager
def started(peer, action, topic, n):
    words = [peer, action, str(DOMAIN), topic, str(n)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "READY\n"
            yield process
        finally:
            process.kill()


def test_fast_dds_receives_what_the_bridge_sends(peer):
    settings = Ros2Settings(domain=DOMAIN, messages=("array",), history=1000)
    bridge = Ros2Bridge(settings, Context("ros2", ManualClock(0)))
    list(bridge.start())
    writer = bridge._writers["array /skin/taxels"]
    skin = skin_state(n_rows=3, n_cols=4, mask=None)
    with started(peer, "read", "rt/skin/taxels/array", 20) as process:
        wait_until(writer.readers, "the reader")
        list(bridge.step(skin))
        for k in range(20):
            forces = np.full((1, 3, 4), k / 8, np.float32)
            list(bridge.step(Taxels(stamp_ns=k + 1, patch="skin", forces=forces)))
        received, _ = process.communicate(timeout=60)
    bridge.close({})
    assert received.splitlines() == [
        f"n_rows=3 cols=4 {12 * k / 8:.4f}" for k in range(20)
    ]


def test_the_source_receives_what_fast_dds_sends(peer):
    with started(peer, "write", "rt/glove/array", 20):
        found = list(
            islice(frames(f"ros2:/glove/array?domain={DOMAIN}&timeout_s=60"), 20)
        )
    for k, (_, forces) in enumerate(found):
        expected = np.float32(k) + np.arange(24, dtype=np.float32) / np.float32(100)
        np.testing.assert_allclose(forces, expected.reshape(4, 6), rtol=1e-6)
