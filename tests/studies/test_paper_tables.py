"""The paper's tables again: bases, points and the page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.sensor.scenes.scenes import SCENES
from sparseskin.studies.frames import first_contact, scene_frames
from sparseskin.studies.paper_tables import study as paper_study
from sparseskin.studies.paper_tables.few_levels_haar import FewLevelsHaarBasis
from sparseskin.studies.paper_tables.numbers import ITERATIONS, PAPER, RATIOS
from sparseskin.studies.paper_tables.page import Results, deviations_db, write
from sparseskin.studies.paper_tables.study import (
    frame_maps,
    reconstructed,
    scene_figures,
    untouched,
)

PAPER_SETTINGS = {"iterations": 10, "lambda_n": 0.1 / 32, "few_levels": False}


@given(
    n_rows=st.sampled_from([1, 2, 5, 8, 12, 40]),
    n_cols=st.sampled_from([1, 3, 4, 32, 40]),
    seed=st.integers(0, 99),
)
def test_haar_of_few_levels_is_orthonormal(n_rows: int, n_cols: int, seed: int) -> None:
    basis = FewLevelsHaarBasis(n_rows, n_cols)
    rng = np.random.default_rng(seed)
    u, v = rng.standard_normal((2, n_rows, n_cols), dtype=np.float32)
    np.testing.assert_allclose(basis.synthesis(basis.analysis(u)), u, atol=1e-5)
    inner = float((basis.analysis(u) * v).sum(dtype=np.float64))
    assert inner == pytest.approx(float((u * basis.synthesis(v)).sum(dtype=np.float64)), abs=1e-3)


def test_it_stops_where_a_side_gets_odd_and_is_haar_where_none_does() -> None:
    assert FewLevelsHaarBasis(40, 40).shapes[-1] == (5, 5)
    assert FewLevelsHaarBasis(40, 64).shapes[-1] == (5, 8)
    image = np.random.default_rng(0).standard_normal((64, 64), dtype=np.float32)
    few, all_levels = FewLevelsHaarBasis(64, 64), HaarBasis(64, 64)
    np.testing.assert_allclose(few.analysis(image), all_levels.analysis(image), atol=1e-5)


@pytest.mark.parametrize("scene", PAPER)
def test_the_papers_tables_agree_with_each_other_and_with_the_scenes(scene: str) -> None:
    paper, ours = PAPER[scene], SCENES[scene]()
    assert paper.by_ratio[3] == paper.by_iterations[30]
    assert paper.n == ours.shape[0] * ours.shape[1]
    assert paper.steps == ours.n_steps


def test_noise_of_a_frame_does_not_depend_on_which_frames_are_asked_for() -> None:
    every = list(scene_frames("lift_box_40", 3, stop=335))
    some = list(scene_frames("lift_box_40", 3, first=315, stop=335, every=5))
    assert len(some) == 4
    for (truth, taxels), (truth_again, taxels_again) in zip(every[315::5], some, strict=True):
        np.testing.assert_array_equal(truth, truth_again)
        np.testing.assert_array_equal(taxels, taxels_again)


def test_the_first_contact_is_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = first_contact("path_40", 0)
    truths = [truth.max() for truth, _ in scene_frames("path_40", 0, stop=frame + 1)]
    assert max(truths[:-1]) <= 0.01 < truths[-1]


@pytest.fixture
def few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_study, "QUICK_BEFORE", 5)
    monkeypatch.setattr(paper_study, "QUICK_AFTER", 20)


def test_a_peg_of_fourteen_taxels_has_few_coefficients_and_d4_has_more(few_frames: None) -> None:
    figures = scene_figures({"scene": "path_40", "seed": 0, "quick": True})
    assert len(figures["contact"]) == 25
    touched = np.array(figures["contact"])
    d2, d4 = np.array(figures["d2"]), np.array(figures["d4"])
    assert not d2[~touched][0]
    # Each taxel is in one coefficient of each kind and level: 14 x 3 x 3 and 25 at the most.
    assert 14 <= d2[touched].max() <= 14 * 9 + 25
    assert (d4[touched] >= d2[touched]).all()
    assert len(figures["d2_shifted"]) in (0, 8)


def test_a_reconstructed_scene_is_the_same_again_and_better_with_more_measurements(
    few_frames: None,
) -> None:
    point = {"scene": "path_40", "seed": 0, "quick": True, **PAPER_SETTINGS}
    third = reconstructed(point | {"ratio": 3})
    assert third == reconstructed(point | {"ratio": 3})
    assert min(third["psnr_db"]) > min(reconstructed(point | {"ratio": 8})["psnr_db"])


def test_an_untouched_skin_is_reconstructed_better_with_a_larger_lambda() -> None:
    point = {"side": 40, "seed": 0, "ratio": 3, "few_levels": False, "n_frames": 8}
    low, high = (untouched(point | {"lambda_n": x})["highest_db"] for x in (0.003, 0.025))
    assert 50 < low < high


def test_maps_are_of_the_frames_that_were_asked_for() -> None:
    frame = first_contact("path_40", 0) + 3
    point = {"scene": "path_40", "seed": 0, "ratio": 3, **PAPER_SETTINGS, "frames": [frame]}
    found = frame_maps(point)
    ((truth, taxels, forces),) = found["maps"]
    ((expected, read),) = scene_frames("path_40", 0, frame, frame + 1)
    np.testing.assert_allclose(truth, expected, atol=1e-4)
    np.testing.assert_allclose(taxels, read, atol=1e-4)
    assert np.shape(forces) == (40, 40)
    assert found["psnr_db"][0][0] > 40


def made_up() -> Results:
    """Figures of ten frames a scene."""
    rng = np.random.default_rng(0)

    def psnr() -> list[float]:
        return rng.uniform(30, 50, 10).tolist()

    scene = {"first": 0, "contact": [k > 4 for k in range(10)], "d2_shifted": [9.0] * 8}
    counts = {key: list(range(10)) for key in ("d2", "d4", "d2_exact", "d4_exact")}
    settings = [(ratio, 30, few) for ratio in RATIOS for few in (False, True)]
    settings += [(3, k, False) for k in ITERATIONS]
    return Results(
        quick=False,
        scenes={name: {**scene, **counts, "noisy_db": psnr()} for name in PAPER},
        psnr={(name, *how): psnr() for name in PAPER for how in settings},
        times={
            (name, k): {"median_ms": 1.0, "mean_ms": 1.0, "p99_ms": 2.0}
            for name in PAPER
            for k in ITERATIONS
        },
    )


def test_a_deviation_is_zero_where_the_upper_ends_are_the_papers() -> None:
    ends = {1600: {4: 62.625, 3: 60.425, 2: 58.0}, 4096: {4: 54.85, 3: 54.0, 2: 53.4}}
    highest = {
        (side, few, ratio): [ends[side**2][ratio], ends[side**2][ratio] + 2]
        for side, few in ((40, True), (64, True))
        for ratio in RATIOS
    }
    assert deviations_db(highest, few_levels=True) == pytest.approx([0, 2])


CHARTS = ("maps", "psnr_by_m", "psnr_by_iterations", "untouched", "coefficients")


def test_the_page_has_every_scenario_and_reports_what_differs(tmp_path: Path) -> None:
    highest = {
        (side, few, ratio): [51.0, 52.0]
        for side, few in ((40, False), (40, True), (64, True))
        for ratio in RATIOS
    }
    image = np.random.default_rng(0).uniform(0, 1, (40, 40)).tolist()
    maps = [(title, 3, [image] * 3, (40.0, 41.0)) for title in ("representative", "worst")]
    write(tmp_path, made_up(), (0.003, 0.025), highest, maps)
    page = (tmp_path / "paper-tables.md").read_text()
    for scenario in PAPER.values():
        assert f"{scenario.title} ({scenario.n})" in page
    assert "## What differs, and why" in page
    assert "**Time: 8 to 32 times less than the paper's**" in page
    assert "nan" not in page
    for name in CHARTS:
        assert f"]({name}.png)" in page
        assert (tmp_path / f"{name}.svg").stat().st_size > 1000
    for name in ("table_1", "table_2", "table_3", "table_4"):
        assert (tmp_path / f"{name}.csv").read_text().count("\n") >= 7


def test_the_frames_of_the_maps_are_of_median_and_of_least_psnr() -> None:
    results = made_up()
    psnr = np.array(results.psnr["path_40", 3, 20, False])
    chosen = results.chosen_frames("path_40")
    contact = range(5, 10)
    assert chosen["worst"] == min(contact, key=lambda k: psnr[k])
    assert chosen["representative"] == sorted(contact, key=lambda k: psnr[k])[2]
