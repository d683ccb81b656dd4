"""The paper's tables again: bases, points and the page."""

import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.sensor.scenes.scenes import SCENES
from sparseskin.studies.frames import SceneFrames, first_contact
from sparseskin.studies.paper import tables
from sparseskin.studies.paper.few_levels_haar import FewLevelsHaarBasis
from sparseskin.studies.paper.numbers import ITERATIONS, PAPER, RATIOS
from sparseskin.studies.paper.results import FITTED, Results


def test_it_stops_where_a_side_gets_odd_and_is_haar_where_none_does():
    for shape, n_left in (((40, 40), 5 * 5), ((40, 64), 5 * 8)):
        even = FewLevelsHaarBasis(*shape).analysis(np.ones(shape, np.float32))
        assert np.count_nonzero(np.abs(even) > 1e-4) == n_left
    image = np.random.default_rng(0).standard_normal((64, 64), dtype=np.float32)
    few, all_levels = FewLevelsHaarBasis(64, 64), HaarBasis(64, 64)
    np.testing.assert_allclose(few.analysis(image), all_levels.analysis(image), atol=1e-5)


@pytest.mark.parametrize("scene", PAPER)
def test_the_papers_tables_agree_with_each_other_and_with_the_scenes(scene):
    paper, ours = PAPER[scene], SCENES[scene]()
    assert (paper.by_ratio[3], paper.n) == (paper.by_iterations[30], ours.shape[0] * ours.shape[1])
    assert paper.steps == ours.n_steps


def test_a_peg_of_fourteen_taxels_has_few_coefficients_and_d4_has_more():
    frames = asdict(SceneFrames("path_40", -5, 20))
    figures = tables.scene_figures({"frames": frames, "seed": 0})
    assert (len(figures["contact"]), figures["first"]) == (25, first_contact("path_40", 0) - 5)
    touched = np.array(figures["contact"])
    d2, d4 = np.array(figures["d2"]), np.array(figures["d4"])
    assert not d2[~touched][0]
    # Each taxel is in one coefficient of each kind and level: 14 x 3 x 3 and 25 at the most.
    assert 14 <= d2[touched].max() <= 14 * 9 + 25
    assert (d4[touched] >= d2[touched]).all()


def made_up():
    """Figures of ten frames a scene."""
    rng = np.random.default_rng(0)

    def psnr():
        return rng.uniform(30, 50, 10)

    scene = {"first": 0, "contact": [k > 4 for k in range(10)]}
    counts = {key: list(range(10)) for key in ("d2", "d4", "d2_exact", "d4_exact")}
    methods = [(ratio, name) for ratio in RATIOS for name in ("30", FITTED)]
    methods += [(3, str(k)) for k in ITERATIONS]
    return Results(
        quick=False,
        scenes={name: {**scene, **counts, "noisy_db": psnr()} for name in PAPER},
        psnr={(name, *of): psnr() for name in PAPER for of in methods},
        times_ms={(name, str(k)): 1.0 for name in PAPER for k in ITERATIONS},
    )


def test_reasons_state_what_the_text_of_the_page_asks_for():
    highest = {
        (side, few, ratio): [51.0, 52.0]
        for side, few in ((40, False), (40, True), (64, True))
        for ratio in RATIOS
    }
    reasons = made_up().reasons((0.003, 0.025), highest)
    assert reasons["speedups"] == "8 to 32"
    notes = Path(tables.__file__).with_name("notes.md").read_text()
    section = notes[notes.index("## What differs") :]
    assert set(re.findall(r"{(\w+)}", section)) == set(reasons)
    assert "nan" not in str(reasons)
