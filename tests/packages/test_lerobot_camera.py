"""The camera of LeRobot, in LeRobot: python -m pytest tests/packages, where both are installed."""

from __future__ import annotations

import itertools
import sys
import threading
import time
import uuid
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bags import N_COLS, N_ROWS, PERIOD_NS, frame, skin_state
from exported import contacts
from processes import announced

from sparseskin.launch.run.running import RunningGraph, RunningNode
from sparseskin.messages import Reconstruction
from sparseskin.nodes.network.sockets import Writer, make_context

pytest.importorskip("lerobot", reason="lerobot is not installed")
camera_package = pytest.importorskip(
    "lerobot_camera_sparseskin",
    reason="packages/lerobot_camera_sparseskin is not installed",
)
TOPICS = ["/skin/skin", "/skin/reconstruction", "/skin/contacts"]
SEND_S = 0.01


def solved(k: int) -> Reconstruction:
    """Frame k: a force of k on the first taxel, none elsewhere but for the last, the range."""
    found = frame(0)[3]
    assert isinstance(found, Reconstruction)
    forces = np.zeros((N_ROWS, N_COLS), np.float32)
    forces[0, 0] = k
    forces[-1, -1] = 255
    return replace(found, stamp_ns=k * PERIOD_NS, forces=forces)


@pytest.fixture
def graph(tmp_path, monkeypatch):
    """A graph that publishes frames 0 to 254 again and again."""
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    context = make_context()
    writer = Writer(context, f"ipc://@sparseskin-{uuid.uuid4().hex}", "host")
    stopped = threading.Event()

    def publish() -> None:
        for seq, k in enumerate(itertools.cycle(range(255))):
            for message in (skin_state(f_max=255.0), solved(k), contacts(k)):
                writer.serve_subscriptions()
                writer.send(message.published("0" * 16, seq))
            if stopped.wait(SEND_S):
                return

    thread = threading.Thread(target=publish)
    nodes = {"host": RunningNode("reconstructor", writer.endpoint, TOPICS)}
    with announced(
        RunningGraph("touched", 1, time.time_ns() - time.monotonic_ns(), "", nodes)
    ):
        thread.start()
        yield
        stopped.set()
        thread.join()
    context.destroy(linger=0)


def camera(**settings: Any) -> Any:
    config = camera_package.SparseskinCameraConfig(width=70, height=50, **settings)
    return camera_package.SparseskinCamera(config)


def test_images_are_the_taxels_in_grey_and_each_is_read_once(graph):
    assert camera().find_cameras() == [
        {"type": "sparseskin", "id": "skin", "graph": "touched-1"}
    ]
    with camera() as one:
        levels = []
        for _ in range(5):
            image = one.async_read(timeout_ms=60_000)
            assert image.shape == (50, 70, 3)
            assert image.dtype == np.uint8
            assert (image[:10, :10] == image[0, 0]).all()  # a taxel
            assert (image[40:, 60:] == 255).all()
            assert not image[10:40].any()
            levels.append(int(image[0, 0, 0]))
        assert len(set(levels)) == 5
        assert one.read_latest(max_age_ms=60_000).shape == (50, 70, 3)


@pytest.mark.parametrize(
    ("settings", "fault"),
    [
        ({"patch": "hand"}, "touched-1: publishes no /hand/skin"),
        ({"graph": "other"}, "no such graph runs"),
        ({"width": 3}, r"less than the \(5, 7\) taxels"),
    ],
)
def test_what_a_graph_does_not_have_is_one_line(graph, settings, fault):
    config = camera_package.SparseskinCameraConfig(**{"height": 50, **settings})
    with pytest.raises(ConnectionError, match=fault):
        camera_package.SparseskinCamera(config).connect()


@pytest.mark.parametrize("settings", [{"width": 0}, {"contacts": -1}, {"f_max": 0.0}])
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        camera_package.SparseskinCameraConfig(**settings)


def test_lerobot_records_images_and_the_contacts_of_the_same_frames(
    graph, tmp_path, monkeypatch
):
    import av
    import lerobot_arm  # noqa: F401
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.scripts import lerobot_record

    root = tmp_path / "recorded"
    palm = "{type: sparseskin, patch: skin, contacts: 2, width: 140, height: 100}"
    words = {
        "robot.type": "skinned", "robot.base": f"{{type: one_joint, cameras: {{palm: {palm}}}}}",
        "teleop.type": "one_joint_leader", "play_sounds": "false", "dataset.root": root,
        "dataset.repo_id": "local/touch", "dataset.single_task": "touch", "dataset.vcodec": "h264",
        "dataset.num_episodes": 1, "dataset.episode_time_s": 2, "dataset.push_to_hub": "false",
    }  # fmt: skip
    monkeypatch.setattr(
        sys, "argv", ["lerobot-record", *(f"--{k}={v}" for k, v in words.items())]
    )
    lerobot_record.main()
    found = LeRobotDataset("local/touch", root=root)
    names = found.features["observation.state"]["names"]
    assert names[:3] == ["joint.pos", "palm.trusted", "palm.contact_1.total"]
    assert len(names) == 1 + 1 + 2 * 10
    with av.open(
        str(next(root.glob("videos/observation.images.palm/*/*.mp4")))
    ) as video:
        images = [image.to_ndarray(format="rgb24") for image in video.decode(video=0)]
    places = [
        names.index(f"palm.{name}")
        for name in ("trusted", "contact_1.total", "contact_2.total")
    ]
    rows = np.array(found.hf_dataset["observation.state"])[:, places]
    assert len(images) == len(rows) > 0
    for image, (trusted, *totals) in zip(images, rows, strict=True):
        k = round(totals[0] - 0.5) if totals[0] else 0
        assert totals == [0.5 + k if n < k % 3 else 0 for n in range(2)]
        assert trusted == (k != 4)
        # The first taxel in the image, of a lossy video, has the force k.
        assert k % 3 == 0 or image[2:18, 2:18].mean() == pytest.approx(k, abs=8)
