"""Study `train`: its presses, and the network in PyTorch beside the gates in numpy."""

from io import BytesIO

import numpy as np
import pytest

from sparseskin.nodes.reconstructor.skin.backend import ManyPatches
from sparseskin.nodes.reconstructor.skin.gates import WINDOW, Gates
from sparseskin.studies.points import StudyError
from sparseskin.studies.training import train
from sparseskin.studies.training.presses import N_FRAMES, SIDE, masks, presses


def test_presses_of_a_seed_have_a_peak_of_1_move_and_leave_most_taxels_untouched():
    made = presses(200, 0)
    assert made.shape == (200, N_FRAMES, SIDE, SIDE)
    assert made.min() >= 0
    np.testing.assert_allclose(made.max(axis=(1, 2, 3)), 1, rtol=1e-6)
    np.testing.assert_array_equal(presses(40, 3), presses(40, 3))
    assert not np.array_equal(presses(40, 4), presses(40, 3))
    assert 0.3 < np.mean(np.mean(made[:, 0] < 0.01, axis=(1, 2)) > 0.5) < 0.95
    assert 0.2 < np.mean(np.abs(made[:, 1] - made[:, 0]).max(axis=(1, 2)) > 0.02) < 0.95
    # Of a few skins some taxels are missing.
    exist = masks(np.random.default_rng(0), 200)
    assert set(np.unique(exist)) == {0.0, 1.0}
    assert 0.1 < np.mean(exist.mean(axis=(1, 2)) < 1) < 0.3


def test_without_pytorch_the_study_names_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(train, "find_spec", lambda name: None)
    with pytest.raises(StudyError, match=r"sparseskin\[train\]"):
        train.run(tmp_path, quick=True, seed=0, executor="")


def test_network_and_gates_are_the_same():
    torch = pytest.importorskip("torch")
    from sparseskin.studies.training.network import first_network, weights

    network = first_network(0)
    content = BytesIO()
    np.savez(content, **weights(network))
    gates = Gates.read(content.getvalue(), "trained")
    shape = (50, WINDOW * WINDOW)
    windows = 3 * np.random.default_rng(0).standard_normal(shape, dtype=np.float32)
    tiles, error = Gates(**network).gated(torch.tensor(windows), ManyPatches(1, "cpu"))
    found, expected = gates.gated(windows)
    np.testing.assert_allclose(found, tiles.detach().numpy(), atol=1e-4)
    np.testing.assert_allclose(expected, error.detach().numpy(), rtol=1e-4)
