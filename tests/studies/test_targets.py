"""Study `targets`: random scenes, what its points compute, its page, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sparseskin.launch.cli import main
from sparseskin.studies.points import StudyError
from sparseskin.studies.targets import is_large, recordings_in
from sparseskin.studies.targets_ablation import WITHOUT, ablated
from sparseskin.studies.targets_bands import banded
from sparseskin.studies.targets_page import write
from sparseskin.studies.targets_points import recorded, restored, touched_lightly
from sparseskin.studies.targets_scenes import F_MAX_N, KINDS, random_scene


@pytest.mark.parametrize("seed", range(10))
def test_random_scenes_are_drawn_by_their_seed_and_touch_the_skin(seed: int) -> None:
    kind, frames = random_scene(seed, 80)
    once = np.array(list(frames))
    again = np.array(list(random_scene(seed, 80)[1]))
    np.testing.assert_array_equal(once, again)
    assert kind == KINDS[seed // 2 % 5]
    assert once.shape == (80, *(((40, 40), (64, 64))[seed % 2]))
    assert once.dtype == np.float32
    assert once.min() == 0
    assert 0.02 < once.max() <= F_MAX_N
    np.testing.assert_array_equal(once[0], 0)
    assert (once > 0).any(axis=0).mean() < 0.6


def test_other_seeds_are_other_scenes() -> None:
    first, other = (np.array(list(random_scene(seed, 60)[1])) for seed in (0, 10))
    assert np.abs(first - other).max() > 0.05


def test_all_methods_of_a_point_have_the_same_frames() -> None:
    point = {"scene": "random 2", "ratio": 3, "n_frames": None, "seed": 0}
    compressed, reading = restored(point), restored({**point, "ratio": 1})
    assert compressed["n"] == reading["n"] == 1600
    assert set(compressed["methods"]) == {"paper", "fista, tuned", "skin", "skin, rotating"}
    skin, paper = (compressed["methods"][name]["mean_db"] for name in ("skin", "paper"))
    raw = reading["methods"]["raw"]["mean_db"]
    assert skin > paper + 5
    assert skin > raw + 5
    assert reading["methods"]["skin"]["mean_db"] > raw + 5
    zones = [value["mean_db"] for name, value in reading["methods"].items() if "zone" in name]
    assert max(zones) > raw


def test_the_time_of_pylops_is_that_of_the_same_run() -> None:
    pytest.importorskip("pylops")
    point = {"scene": "random 2", "ratio": 3, "n_frames": None, "seed": 0}
    assert restored(point)["pylops_ms"] > 0


def test_bands_hold_parts_of_the_truth() -> None:
    point = {"scene": "random 2", "ratio": 4, "rows": "rotating", "n_frames": None, "seed": 0}
    held = banded(point)
    assert set(held) == {"touched", "untouched", "total", "row", "col"}
    assert all(0.7 < part <= 1 for part in held.values())


def test_a_light_touch_is_counted_and_false_ones_too() -> None:
    point = {"side": 40, "ratio": 3, "solver": "skin", "n_trials": 10, "seed": 1}
    figures = touched_lightly(point)
    assert figures["found"] >= 0.8
    assert figures["false"] < 0.02
    assert touched_lightly(point) == figures


def test_a_recording_is_its_own_truth(tmp_path: Path) -> None:
    path = tmp_path / "press.npy"
    np.save(path, np.array(list(random_scene(2, 80)[1])))
    points = [
        {"path": str(path), "ratio": ratio, "solver": "skin", "seed": 0} for ratio in (1, 2, 16)
    ]
    full, half, sixteenth = (recorded(point) for point in points)
    assert full["error"] < 0.02
    assert full["error"] < half["error"] < sixteenth["error"]
    assert full["n_contact"] == half["n_contact"] > 20


def test_each_ingredient_can_be_left_out_and_changes_the_result() -> None:
    figures = ablated(
        {"scene": "random 0", "ratio": 3, "rows": "rotating", "n_frames": None, "seed": 0}
    )
    assert set(figures) == set(WITHOUT)
    whole = figures["all of it"]["mean_db"]
    assert all(f["mean_db"] != whole for name, f in figures.items() if name not in _INDIFFERENT)
    for name in ("last frame", "shifts", "garrote (soft threshold instead)"):
        assert figures[name]["mean_db"] < whole - 0.5


_INDIFFERENT = (*("all of it", "doubt of a lagging filter", "caution where too much is explained"),)


def test_the_page_holds_every_scene_and_says_what_is_missing(tmp_path: Path) -> None:
    n_frames, seed = None, 0
    pairs = []
    for ratio in (1, 3, 4, 8):
        point = {"scene": "random 2", "ratio": ratio, "n_frames": n_frames, "seed": seed}
        pairs.append((point, restored(point)))
    light = {"side": 40, "ratio": 4, "solver": "skin", "n_trials": 1, "seed": 0}
    ablation = {
        "scene": "random 2",
        "ratio": 3,
        "rows": "fixed",
        "n_frames": n_frames,
        "seed": seed,
    }
    pytest.importorskip("matplotlib")
    told = (light, touched_lightly(light))
    bands = (ablation, banded(ablation))
    write(tmp_path, pairs, [told], [bands], [], [(ablation, ablated(ablation))])
    page = (tmp_path / "targets.md").read_text()
    assert page.count("| random 2 | N/3 |") == 2
    assert page.count("| random 2 | fixed |") == page.count("| **mean** | fixed |") == 1
    assert page.count("| N/3 | skin, rotating |") == 1
    assert "--recordings" in page
    for name in ("gain_skin.png", "gain_skin_rotating.svg", "ablation.png", "scenes.csv"):
        assert (tmp_path / name).stat().st_size > 100
        assert name in page
    assert all(f"| {name} |" in page for name in list(WITHOUT)[1:])


def test_which_scenes_are_large() -> None:
    assert [is_large(name) for name in ("lift_box_64", "path_40", "random 3", "random 10")] == [
        *(True, False, True, False)
    ]


def test_recordings_are_found_by_suffix_and_a_missing_folder_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("b.lst", "a.CSV", "README.md"):
        (tmp_path / name).write_text("")
    assert [path.name for path in recordings_in(tmp_path)] == ["a.CSV", "b.lst"]
    assert recordings_in(None) == []
    assert "--recordings" in capsys.readouterr().err
    with pytest.raises(StudyError, match="no_such: No such file"):
        recordings_in(tmp_path / "no_such")


def test_recordings_are_refused_by_other_studies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    options = ["--out", str(tmp_path), "--recordings", str(tmp_path)]
    assert main(["study", "scene-needs", *options]) == 2
    assert "--recordings: study 'scene-needs' takes none" in capsys.readouterr().err
