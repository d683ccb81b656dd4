"""Study `tasks`: drawn shapes, sets of frames that the user has, the classifier, and its page."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("sklearn")

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.numerics.compiled import ENVIRONMENT
from sparseskin.studies.points import StudyError
from sparseskin.studies.tasks import classifier, shapes, tables
from sparseskin.studies.tasks.classifier import Classifier
from sparseskin.studies.tasks.sets import read_set
from sparseskin.studies.tasks.ways import ALL, FORCES, LARGER, WAYS, n_bytes


def cover(name, angle):
    """A shape without noise, at the middle."""
    return shapes._forces(
        shapes.SHAPES[name],
        angle,
        np.full(2, (shapes.SIDE - 1) / 2),
        np.random.default_rng(0),
    )


@pytest.mark.parametrize("name", shapes.NAMES)
def test_a_shape_looks_the_same_after_its_symmetry_and_at_no_smaller_turn(name):
    order = shapes.SHAPES[name].symmetry
    distance = shapes.SHAPES[name].distance
    u, v = np.random.default_rng(1).uniform(-1.2, 1.2, (2, 2000))

    def turned(angle):
        return distance(
            np.cos(angle) * u - np.sin(angle) * v, np.sin(angle) * u + np.cos(angle) * v
        )

    if order == 0:
        assert np.allclose(turned(1.0), distance(u, v))
        return
    assert np.allclose(turned(2 * np.pi / order), distance(u, v))
    assert not np.allclose(turned(np.pi / order), distance(u, v), atol=0.05)


def test_shapes_differ_from_each_other_at_every_angle():
    images = {name: cover(name, 0.0) for name in shapes.NAMES}
    images = {name: image / np.linalg.norm(image) for name, image in images.items()}
    for name in shapes.NAMES:
        for angle in np.linspace(0, 2 * np.pi, 12):
            image = cover(name, angle)
            for other in shapes.NAMES:
                if other != name:
                    assert (image * images[other]).sum() / np.linalg.norm(image) < 0.98


def test_presses_have_forces_of_a_decade_and_as_many_of_each_shape():
    presses = shapes.draw(120, 3)
    assert (np.bincount(presses.labels) == 10).all()
    peaks = presses.frames.max(axis=(1, 2))
    assert peaks.min() > 0.2
    assert peaks.max() <= 2.5
    assert (shapes.draw(120, 3).frames == presses.frames).all()


@pytest.fixture(autouse=True)
def in_numpy(monkeypatch):
    """Nothing is compiled, which takes longer than all else."""
    monkeypatch.setenv(ENVIRONMENT, "off")


@pytest.mark.parametrize("way", WAYS)
def test_a_way_sends_as_many_numbers_as_its_bytes_say(way):
    frames = shapes.draw(3, 0).frames
    ratio = 1 if way == ALL else 16
    inputs = WAYS[way](frames, ratio, 0)
    sent = frames[0].size if way == FORCES else n_bytes(frames[0].size, ratio) // 2
    assert inputs.shape == (3, sent)


def test_the_classifier_does_not_see_the_size_of_forces():
    rng = np.random.default_rng(0)
    inputs = rng.uniform(0, 1, (12, 5)).astype(np.float32)
    model = Classifier().fit(inputs, ["a", "b"] * 6)
    shares = model.predict_proba(inputs)
    assert np.allclose(shares.sum(axis=1), 1)
    factors = 10 ** rng.uniform(-3, 3, (12, 1))
    assert np.allclose(model.predict_proba(factors * inputs), shares, atol=1e-4)


def test_the_classifier_finds_labels_and_figures_that_are_a_function_of_the_inputs():
    rng = np.random.default_rng(0)
    angles = rng.uniform(0, np.pi, 300)
    inputs = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    labels = np.where(angles < 1.5, "low", "high")
    model = Classifier().fit(inputs[:200], labels[:200], angles[:200, None])
    shares, figures = model.predict_all(inputs[200:])
    assert (model.classes_[shares.argmax(axis=1)] == labels[200:]).mean() > 0.95
    assert np.abs(figures[:, 0] - angles[200:]).max() < 0.05
    with pytest.raises(SparseskinError, match="1 labels"):
        Classifier().fit(inputs, ["a"] * 300)


def written_stemnist(folder, persons=8, labels="AB7"):
    """Recordings as STEMNIST has them: each label is a row of the skin that is written along."""
    h5py = pytest.importorskip("h5py")
    raw = folder / "STEMNIST Dataset" / "RawCharacters"
    raw.mkdir(parents=True)
    rng = np.random.default_rng(0)
    for person in range(persons):
        for row, label in enumerate(labels):
            readings = rng.integers(20, 24, (240, 16, 16)).astype(np.uint8)
            for step in range(16):
                readings[10 * step : 10 * step + 10, 4 * row + 2, step] += 90
            with h5py.File(raw / f"P{person}_{label}_1.h5", "w") as file:
                file["pressure_data"] = readings
    return raw


def test_stemnist_is_read_as_one_frame_a_character_and_split_by_person(tmp_path):
    written_stemnist(tmp_path)
    data = read_set(str(tmp_path))
    assert data.name == "STEMNIST"
    assert data.frames.shape == (24, 16, 16)
    row = {"A": 2, "B": 6, "7": 10}
    for frame, label in zip(data.frames, data.labels, strict=True):
        assert (frame[row[label]] > 80).all()
        assert np.delete(frame, row[label], axis=0).max() < 4
    is_test = data.is_test(0)
    assert is_test.sum() == 6
    assert not set(data.groups[is_test]) & set(data.groups[~is_test])


def test_a_set_is_recognised_by_examples_that_are_not_trained(tmp_path, monkeypatch):
    monkeypatch.setattr(classifier, "GRID", {"gamma": (1.0,), "alpha": (0.01,)})
    frames = np.random.default_rng(0).uniform(0, 1, (40, 8, 8))
    labels = np.array(["up", "down"] * 20)
    frames[labels == "up", :4] += 3
    frames[labels == "down", 4:] += 3
    np.savez(tmp_path / "halves.npz", frames=frames, labels=labels)
    point = {"folder": str(tmp_path), "digest": "", "seed": 0}
    for way in (ALL, LARGER):
        ratio = 1 if way == ALL else 8
        found = tables.of_frames({**point, "way": way, "ratio": ratio})
        assert found == {"task": "halves", "n_bytes": 128 // ratio, "accuracy": 100.0}


def damaged_set(folder, how):
    arrays = {"frames": np.ones((4, 3, 3)), "labels": np.array(["a", "b"] * 2)}
    if how == "two":
        np.savez(folder / "b.npz", **arrays)
    if how == "no labels":
        del arrays["labels"]
    if how == "labels of another length":
        arrays["labels"] = arrays["labels"][:3]
    if how == "negative":
        arrays["frames"] = -arrays["frames"]
    if how == "objects":
        arrays["labels"] = np.array([{}, 1, None, "a"], dtype=object)
    if how == "flat":
        arrays["frames"] = arrays["frames"][0]
    np.savez(folder / "a.npz", **arrays)
    if how == "cut":
        (folder / "a.npz").write_bytes((folder / "a.npz").read_bytes()[:200])


@pytest.mark.parametrize(
    ("how", "text"),
    [
        ("two", "2 files .npz; allowed: RawCharacters"),
        ("no labels", "no array 'labels'; needed are frames and labels"),
        ("labels of another length", r"labels are \(3,\), not \(4,\) as frames"),
        ("negative", "a number that is negative or not finite"),
        ("objects", "no .npz of numbers and texts can be read"),
        ("flat", r"frames are float64 \(3, 3\), not numbers"),
        ("cut", "no .npz of numbers and texts can be read"),
    ],
)
def test_a_set_that_is_not_as_described_gets_one_line(how, text, tmp_path):
    damaged_set(tmp_path, how)
    with pytest.raises(StudyError, match=text) as caught:
        read_set(str(tmp_path))
    assert "\n" not in str(caught.value)


def test_recordings_that_are_not_of_stemnist_get_one_line(tmp_path):
    raw = written_stemnist(tmp_path, 1, "A")
    (raw / "P1_AB_1.h5").write_bytes(b"")
    with pytest.raises(StudyError, match=r"expected a name as AT_A_1\.h5"):
        read_set(str(tmp_path))
    (raw / "P1_AB_1.h5").rename(raw / "P1_B_1.h5")
    with pytest.raises(StudyError, match=r"P1_B_1\.h5: no recording of STEMNIST"):
        read_set(str(tmp_path))
    with pytest.raises(StudyError, match="no such folder"):
        read_set(str(tmp_path / "nowhere"))
