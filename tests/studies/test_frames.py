"""Frames of scenes, presses and recordings, as studies take them."""

import itertools

import numpy as np
import pytest

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.recorder.convert.to_bag import import_file
from sparseskin.nodes.sensor.noise import NoiseModel
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
from sparseskin.studies.presses import (
    BODIES,
    COURSES,
    N_BEFORE,
    RAMP,
    SKINS,
    Timing,
    press_frames,
    scattered_mask,
)

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
    for (truth, taxels), (truth_again, taxels_again) in zip(
        every[315::5], some, strict=True
    ):
        np.testing.assert_array_equal(truth, truth_again)
        np.testing.assert_array_equal(taxels, taxels_again)


def test_frames_of_a_scene_are_counted_from_its_first_contact_and_from_half_way_on():
    frames = SceneFrames("lift_box_40", -4, 6, 2, later=3)
    contact = first_contact("lift_box_40", 0)
    truths = [
        truth.max() for truth, _ in scene_frames("lift_box_40", 0, stop=contact + 1)
    ]
    assert max(truths[:-1]) <= 0.01 < truths[-1]
    (first, stop), (half, end) = frames.windows(0)
    assert first == contact - 4
    assert stop == contact + 6
    assert half > contact
    assert end == half + 6
    assert [len(list(part)) for part in frames.open(0).parts()] == [5, 3]


def test_the_part_of_a_recording_is_the_loaded_one_next_to_its_middle(tmp_path):
    frames = np.zeros((100, 4, 4), dtype=np.float32)
    frames[20:40] = 1
    np.save(tmp_path / "a.npy", frames)
    part = part_of(str(tmp_path / "a.npy"), 30)
    assert part.first == 20
    assert len(part.frames) == 30
    assert part.n_recorded == 100
    whole = part_of(str(tmp_path / "a.npy"), 100)
    assert whole.first == 0
    assert whole.norm == 4
    assert whole.total == 16


def test_a_bag_of_a_recording_is_the_same_as_its_file(folder):
    import_file(folder / "press.npz", folder / "copy.mcap")
    assert [path.name for path in readable(files_in(folder), 60)] == [
        "copy.mcap",
        "press.npz",
    ]
    bag, file = (
        RecordedFrames(str(folder / name), "", 60, unscored=8).open(0)
        for name in ("copy.mcap", "press.npz")
    )
    for one, other in zip(
        *(pair for take in (bag, file) for pair in take.parts()), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(bag.mask, file.mask)
    assert bag.f_max == file.f_max
    assert bag.norm == file.norm
    assert bag.total == file.total
    assert file.n == 114
    assert file.unscored == 8


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
    (folder / "none").mkdir()
    with pytest.raises(StudyError, match=r"no recording; allowed are .*\.mcap"):
        files_in(folder / "none")
    with pytest.raises(StudyError, match="No such file"):
        files_in(folder / "gone")
    (folder / "none/a.npy").write_text("x")
    with pytest.raises(StudyError, match="none of 1 files can be used"):
        readable(files_in(folder / "none"), 60)


def frames_of(body="peg", shape=(20, 20), n=80, seed=0, **chosen):
    pairs = list(press_frames(body, shape, n, seed, **chosen))
    return np.array([truth for truth, _ in pairs]), np.array(
        [reading for _, reading in pairs]
    )


@pytest.mark.parametrize("shape", SKINS)
def test_every_body_presses_every_skin_within_its_range(shape):
    for body, course in itertools.product(BODIES, COURSES):
        truth, reading = frames_of(body, shape, 70, course=course)
        assert truth.dtype == reading.dtype == np.float32
        assert truth.shape == (70, *shape)
        np.testing.assert_array_equal(truth, reading)
        assert truth.min() == 0
        assert 0.2 < truth.max() <= 2.5
        assert not truth[:N_BEFORE].any()
        assert truth[N_BEFORE + RAMP // 2].any()


@pytest.mark.parametrize("active", [0.01, 0.6])
@pytest.mark.parametrize("body", BODIES)
def test_a_body_touches_about_the_stated_part_of_the_skin(body, active):
    truth, _ = frames_of(body, (40, 40), 120, active=active)
    touched = np.count_nonzero(truth[N_BEFORE + RAMP :], axis=(1, 2)) / 1600
    assert 0.6 * active < np.median(touched) < 1.25 * active + 0.005


def test_a_moving_body_moves_by_its_speed_in_each_frame_but_where_it_turns_back():
    speed = 0.3
    truth, _ = frames_of("peg", (64, 64), 150, speed=speed, active=0.02)
    i, j = np.indices((64, 64))
    pressed = truth[N_BEFORE + 1 :].astype(np.float64)
    totals = pressed.sum(axis=(1, 2))
    centres = np.stack(
        [(pressed * of).sum(axis=(1, 2)) / totals for of in (i, j)], axis=1
    )
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert np.median(steps) == pytest.approx(speed, rel=0.05)


def test_parts_of_a_course_last_as_many_frames_as_are_stated():
    timing = Timing(untouched=3, ramp=5, pause=2, contact=4)
    ramped, _ = frames_of("gaussian", course="ramped", n=15, timing=timing)
    totals = ramped.sum(axis=(1, 2))
    np.testing.assert_allclose(
        totals / totals.max(),
        [0, 0, 0, 0.2, 0.4, 0.6, 0.8, 1, 0.8, 0.6, 0.4, 0.2, 0, 0, 0],
        rtol=1e-5,
    )
    sudden, _ = frames_of("gaussian", course="sudden", n=15, timing=timing)
    touched = sudden.any(axis=(1, 2)).tolist()
    assert touched == 3 * [False] + 4 * [True] + 2 * [False] + 4 * [True] + 2 * [False]
    moving, _ = frames_of("peg", course="moving", n=15, speed=0.0, timing=timing)
    rising = moving.sum(axis=(1, 2))
    assert np.argmax(rising > 0.999 * rising.max()) == 3 + 5 - 1


def test_cells_without_a_taxel_bear_no_force_and_read_0():
    mask = scattered_mask((20, 20), 42, seed=1)
    assert np.count_nonzero(mask) == 42
    truth, reading = frames_of(active=0.5, mask=mask, noise=NoiseModel())
    assert not truth[:, ~mask].any()
    assert not reading[:, ~mask].any()
    touched = np.count_nonzero(truth[N_BEFORE + RAMP :], axis=(1, 2)) / 42
    assert 0.3 < np.median(touched) < 0.7
