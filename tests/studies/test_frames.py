"""Frames of scenes, presses and recordings, as studies take them."""

import numpy as np
import pytest

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.recorder.convert.to_bag import import_file
from sparseskin.studies.accuracy.experiments import readable
from sparseskin.studies.frames import (
    RecordedFrames,
    SceneFrames,
    files_in,
    first_contact,
    part_of,
    scene_frames,
)
from sparseskin.studies.points import StudyError

SHAPE = (12, 10)


@pytest.fixture
def folder(tmp_path):
    """A folder with a recording of a press that comes and goes, masked in a corner."""
    i, j = np.indices(SHAPE)
    frames = np.zeros((40, *SHAPE), dtype=np.float32)
    for k in range(10, 30):
        frames[k] = 50 * np.exp(-((i - 5 - 0.05 * k) ** 2 + (j - 5) ** 2) / 6)
    mask = np.ones(SHAPE, dtype=np.bool_)
    mask[:3, :2] = False
    np.savez(tmp_path / "press.npz", forces=frames * mask, mask=mask, unit="kPa")
    return tmp_path


def test_noise_of_a_frame_does_not_depend_on_which_frames_are_asked_for():
    every = list(scene_frames("lift_box_40", 3, stop=335))
    some = list(scene_frames("lift_box_40", 3, first=315, stop=335, every=5))
    assert len(some) == 4
    for (truth, taxels), (truth_again, taxels_again) in zip(every[315::5], some, strict=True):
        np.testing.assert_array_equal(truth, truth_again)
        np.testing.assert_array_equal(taxels, taxels_again)


def test_frames_of_a_scene_are_counted_from_its_first_contact_and_from_half_way_on():
    frames = SceneFrames("path_40", -4, 6, 2, later=3)
    contact = first_contact("path_40", 0)
    truths = [truth.max() for truth, _ in scene_frames("path_40", 0, stop=contact + 1)]
    assert max(truths[:-1]) <= 0.01 < truths[-1]
    (first, stop), (half, end) = frames.windows(0)
    assert (first, stop) == (contact - 4, contact + 6)
    assert half > contact
    assert (end, [len(list(part)) for part in frames.open(0).parts()]) == (half + 6, [5, 3])


def test_the_part_of_a_recording_is_the_loaded_one_next_to_its_middle(tmp_path):
    frames = np.zeros((100, 4, 4), dtype=np.float32)
    frames[20:40] = 1
    np.save(tmp_path / "a.npy", frames)
    part = part_of(str(tmp_path / "a.npy"), 30)
    assert (part.first, len(part.frames), part.n_recorded) == (20, 30, 100)
    whole = part_of(str(tmp_path / "a.npy"), 100)
    assert (whole.first, whole.norm, whole.total) == (0, 4, 16)


def test_a_bag_of_a_recording_is_the_same_as_its_file(folder):
    import_file(folder / "press.npz", folder / "copy.mcap")
    assert [path.name for path in readable(files_in(folder), 60)] == ["copy.mcap", "press.npz"]
    bag, file = (
        RecordedFrames(str(folder / name), "", 60, unscored=8).open(0)
        for name in ("copy.mcap", "press.npz")
    )
    for one, other in zip(*(pair for take in (bag, file) for pair in take.parts()), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(bag.mask, file.mask)
    assert (bag.f_max, bag.norm, bag.total) == (file.f_max, file.norm, file.total)
    assert (file.n, file.unscored) == (114, 8)


def test_unusable_files_get_one_line_each_and_are_skipped(folder, capsys):
    (folder / "README.md").write_text("no recording")
    (folder / "numbers.csv").write_text("1,2\n3,4\n")
    (folder / "broken.mcap").write_bytes(b"\x89MCAP0\r\n")
    np.savez(folder / "zeros.npz", forces=np.zeros((3, 4, 4)), f_max=1.0)
    assert [path.name for path in readable(files_in(folder), 60)] == ["press.npz"]
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith("accuracy: skipped: ") for line in lines)
    with pytest.raises(SparseskinError, match="nothing touches"):
        part_of(str(folder / "zeros.npz"), 60)


def test_a_folder_without_a_usable_recording_is_refused(tmp_path):
    with pytest.raises(StudyError, match=r"no recording; allowed are .*\.mcap"):
        files_in(tmp_path)
    with pytest.raises(StudyError, match="No such file"):
        files_in(tmp_path / "gone")
    (tmp_path / "a.npy").write_text("x")
    with pytest.raises(StudyError, match="none of 1 files can be used"):
        readable(files_in(tmp_path), 60)
