"""Study slices: a pass that begins anew comes near the one that ran all the time."""

from __future__ import annotations

import pytest

pytest.importorskip("pandas", reason="the extra charts is not installed")

from sparseskin.launch.offline.plan import LEAST_FRAMES, WARM_UP
from sparseskin.nodes.reconstructor.faults.taxels import MEASURED
from sparseskin.studies.slices.seams import WARM_UPS, seams
from sparseskin.studies.slices.study import points_of, table_of


def test_differences_fall_with_the_warm_up() -> None:
    point = {
        **{"source": "path_40", "every": 10, "ratio": 3, "n_frames": 90, "n_seams": 2},
        **{"longest": 32, "seed": 0},
    }
    found = seams(point)
    assert list(found["rms"]) == ["0", "8", "16", "32"]
    assert max(found["rms"]["32"]) < 0.5 * min(found["rms"]["0"])
    lines = table_of([(point, found), ({**point, "ratio": 8}, found)]).splitlines()
    assert len(lines) == 2 + 4 + 1
    assert "other shifts" in lines[-1]


def test_the_warm_up_is_one_that_the_study_measures_and_longer_than_the_watch_for_taxels() -> None:
    assert WARM_UP in WARM_UPS
    assert WARM_UP > MEASURED
    assert LEAST_FRAMES >= 20 * WARM_UP


def test_points_are_scenes_at_two_ratios() -> None:
    assert {point["ratio"] for point in points_of(True, 0, None)} == {3, 8}
