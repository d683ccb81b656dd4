"""The paper's tables again: bases, points and the page."""

from dataclasses import asdict

import numpy as np
import pytest

from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.sensor.scenes.scenes import SCENES
from sparseskin.studies.frames import SceneFrames, first_contact
from sparseskin.studies.paper import tables
from sparseskin.studies.paper.numbers import PAPER
from sparseskin.studies.paper.tables import FewLevelsHaarBasis


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
