"""Exported datasets, in LeRobot: python -m pytest tests/packages, where it is installed."""

import numpy as np
import pytest
from bags import N_COLS, N_ROWS, PERIOD_NS, frame, make_bag, skin_state
from exported import contacts

pytest.importorskip("lerobot", reason="lerobot is not installed")
from sparseskin.launch.commands.cli import main
from sparseskin.messages import Reconstruction
from sparseskin.plugins.bridges.contacts import state

N_TAXELS = N_ROWS * N_COLS
FPS = 30
LENGTHS = (20, 12)


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))


def export(folder, touched, *options):
    bags = []
    for k, n in enumerate(LENGTHS):
        messages = [
            m for at in range(n * 10**9 // FPS // PERIOD_NS + 5) for m in frame(at)
        ]
        found = [contacts(at) for at in range(len(messages) // 4)] if touched else []
        bags.append(folder / f"{k}.mcap")
        make_bag(bags[-1], [skin_state(), *messages, *found])
    out = folder / "out"
    words = [*map(str, bags), "--to", "lerobot", "--out", str(out), *options]
    assert main(["recording", "export", *words]) == 0
    return out


def forces(k):
    (found,) = (m.forces[0].ravel() for m in frame(k) if isinstance(m, Reconstruction))
    return found


def recorded(root):
    """A dataset as LeRobot records it: a camera, two joints, and an action."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    joints = {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]}
    sides = ("height", "width", "channels")
    camera = {"dtype": "video", "shape": (64, 64, 3), "names": sides}
    features = {
        "observation.state": joints,
        "action": joints,
        "observation.images.front": camera,
    }
    made = LeRobotDataset.create("me/arm", fps=FPS, features=features, root=root)
    for n in LENGTHS:
        for k in range(n):
            values = dict.fromkeys(
                ("observation.state", "action"), np.full(2, k, np.float32)
            )
            image = np.full((64, 64, 3), k, np.uint8)
            made.add_frame(
                {**values, "observation.images.front": image, "task": "push"}
            )
        made.save_episode()
    made.finalize()
    return root


def trained(root):
    """The dataset, and the smallest ACT policy after two steps on it."""
    import torch
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.factory import make_policy, make_pre_post_processors

    sizes = dict.fromkeys(("dim_model", "dim_feedforward"), 16)
    sizes |= dict.fromkeys(("n_heads", "n_encoder_layers", "n_vae_encoder_layers"), 1)
    sizes |= dict.fromkeys(("latent_dim", "chunk_size", "n_action_steps"), 4)
    config = ACTConfig(
        **sizes, pretrained_backbone_weights=None, device="cpu", push_to_hub=False
    )
    times = {"action": [k / FPS for k in range(4)]}
    dataset = LeRobotDataset(
        "me/touch", root=root, delta_timestamps=times, video_backend="pyav"
    )
    policy = make_policy(config, ds_meta=dataset.meta)
    prepare, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    optimiser = torch.optim.AdamW(policy.parameters())
    batches = iter(torch.utils.data.DataLoader(dataset, batch_size=4))
    for _ in range(2):
        loss, _ = policy.forward(prepare(next(batches)))
        assert torch.isfinite(loss)
        loss.backward()
        optimiser.step()
        optimiser.zero_grad()
    return dataset, policy


def last_frame(row):
    return row * 10**9 // FPS // PERIOD_NS


@pytest.mark.parametrize(("touched", "window"), [(False, 1), (True, 4)])
def test_act_trains_on_touch_alone(tmp_path, touched, window):
    dataset, policy = trained(export(tmp_path, touched, "--window", str(window)))
    assert dataset.num_episodes == 2
    assert policy.config.env_state_feature.shape == (N_TAXELS,)
    row = dataset[5]
    assert row["observation.tactile.skin"].shape == (window, N_TAXELS)
    assert row["action"].shape == (4, *row["observation.state"].shape)
    for k in range(4):
        of_next = (
            state(contacts(last_frame(6 + k)), 4)
            if touched
            else forces(last_frame(6 + k))
        )
        assert np.array_equal(row["action"][k], of_next)


def test_act_trains_on_a_dataset_with_a_camera_joints_and_touch(tmp_path):
    root = recorded(tmp_path / "arm")
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    dataset, policy = trained(export(tmp_path, True, "--into", str(root)))
    assert {
        path: path.read_bytes() for path in root.rglob("*") if path.is_file()
    } == before
    assert policy.config.image_features.keys() == {"observation.images.front"}
    names = dataset.features["observation.state"]["names"]
    assert names[:3] == ["a.pos", "b.pos", "skin.trusted"]
    for row, k in ((7, 7), (LENGTHS[0] + 5, 5)):  # of the first and the second episode
        expected = [k, k, *state(contacts(last_frame(k)), 4)]
        assert dataset[row]["observation.state"].tolist() == pytest.approx(expected)
        assert np.array_equal(
            dataset[row]["observation.environment_state"], forces(last_frame(k))
        )
        assert dataset[row]["task"] == "push"
