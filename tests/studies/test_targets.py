"""Study `targets`: random scenes, what its points compute, its page, and what it refuses."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.studies.points import StudyError
from sparseskin.studies.report import frame_of
from sparseskin.studies.targets.ablation import WITHOUT
from sparseskin.studies.targets.page import HELD, METHODS, RENAMED, write
from sparseskin.studies.targets.scenes import KINDS, random_scene, side_of
from sparseskin.studies.targets.study import (
    DEAD_ZONES_N,
    SOLVERS,
    ablated,
    banded,
    reconstructed,
    recorded,
    recordings_in,
    touched_lightly,
)


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
    assert 0.02 < once.max() <= PAPER_F_MAX_N
    np.testing.assert_array_equal(once[0], 0)
    assert (once > 0).any(axis=0).mean() < 0.6


def test_other_seeds_are_other_scenes() -> None:
    first, other = (np.array(list(random_scene(seed, 60)[1])) for seed in (0, 10))
    assert np.abs(first - other).max() > 0.05


def test_all_methods_of_a_point_have_the_same_frames() -> None:
    point = {"scene": "random 2", "ratio": 3, "n_frames": None, "seed": 0}
    compressed, reading = reconstructed(point), reconstructed({**point, "ratio": 1})
    assert compressed["n"] == reading["n"] == 1600
    assert set(compressed["methods"]) == {"paper", "fista, tuned", "skin", "skin, rotating"}
    skin, paper = (compressed["methods"][name]["mean_db"] for name in ("skin", "paper"))
    raw = reading["methods"]["raw"]["mean_db"]
    assert skin > paper + 5
    assert skin > raw + 5
    assert reading["methods"]["skin"]["mean_db"] > raw + 5
    zones = [value["mean_db"] for name, value in reading["methods"].items() if "zone" in name]
    assert max(zones) > raw
    # The time of PyLops is that of the same run.
    assert (compressed["pylops_ms"] is None) == (find_spec("pylops") is None)
    assert reading["pylops_ms"] is None


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


_INDIFFERENT = ("all of it", "doubt of a lagging filter")


def test_the_page_holds_every_scene_and_reports_what_is_missing(tmp_path: Path) -> None:
    times = {"p50_ms": 1.0, "p99_ms": 2.0}

    def figures(mean_db: float) -> dict[str, float]:
        return {"mean_db": mean_db, "min_db": mean_db - 10, "touched_n": 0.02, **times}

    solved, n = [], {"n": 1600, "pylops_ms": 20.0}
    for ratio in (1, 3, 4, 8):
        point = {"scene": "random 2", "ratio": ratio, "n_frames": None, "seed": 0}
        zones = [f"dead zone {zone:.2f} N" for zone in DEAD_ZONES_N]
        names = ["raw", *zones, "skin"] if ratio == 1 else list(SOLVERS)
        psnr = {name: 40.0 + 2 * k for k, name in enumerate(names)}
        solved.append((point, {**n, "methods": {k: figures(db) for k, db in psnr.items()}}))
    light = {"side": 40, "ratio": 4, "solver": "skin", "n_trials": 1, "seed": 0}
    bands = {"scene": "random 2", "ratio": 3, "rows": "fixed", "n_frames": None, "seed": 0}
    left_out = {name: figures(50.0 - k) for k, name in enumerate(WITHOUT)}
    write(
        tmp_path,
        reconstructed=frame_of(*zip(*solved, strict=True), "method"),
        touched=frame_of([light], [{"found": 0.95, "false": 0.001}]),
        banded=frame_of([bands], [dict.fromkeys(HELD, 0.9) | {"col": float("nan")}]),
        recorded=frame_of([], []),
        ablated=frame_of([bands], [left_out], "without"),
    )
    page = (tmp_path / "targets.md").read_text()
    assert page.count("| random 2 | N/3 |") == 2
    assert "| random 2 | N/3 | 40.0 / 30.0 | 42.0 / 32.0 | 44.0 / 34.0 | 46.0 / 36.0 |" in page
    assert "40.0 / 30.0 | 54.0 (0.08 N) | 56.0 / 46.0 |" in page
    assert "| 1600, random | N/3 | skin, rotating | +6.0 (+6.0) | +12 | +6.0 | +13 | +6.0" in page
    assert "| random 2 | fixed | 90 / 90 / 90 / 90 / - |" in page
    assert "| **mean** | fixed | 90 / 90 / 90 / 90 / - |" in page
    assert "| 40 x 40 | skin | 95 % | 0.1 % |" in page
    assert "--recordings" in page
    for name in ("gain_skin.png", "gain_skin_rotating.svg", "ablation.png", "scenes.csv"):
        assert (tmp_path / name).stat().st_size > 100
        assert name in page
    names = [RENAMED.get(name, name) for name in WITHOUT]
    assert all(f"| {name} | -{k}.00 |" in page for k, name in enumerate(names) if k)
    assert all(f"Gain of {method} over preset paper" in page for method in METHODS)


def test_sides_of_scenes_and_of_random_ones() -> None:
    scenes = ("lift_box_64", "path_40", "random 3", "random 10")
    assert [side_of(name) for name in scenes] == [64, 40, 64, 40]


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
    options = ["--out", str(tmp_path), "--recordings", str(tmp_path)]
    assert main(["study", "scene-needs", *options]) == 2
    assert "--recordings: study 'scene-needs' takes none" in capsys.readouterr().err
