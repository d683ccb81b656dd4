"""Experiments: their points, candidates side by side on the same frames, and their scores."""

import numpy as np
import pytest

from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.accuracy.experiments import CANDIDATES, READINGS, SIMPLE
from sparseskin.studies.baselines.sampling import CODECS
from sparseskin.studies.evaluate import VALUE_BYTES, Scores, Solved
from sparseskin.studies.frames import PressFrames, UntouchedFrames
from sparseskin.studies.harness import (
    SCORES,
    TIMED_ON,
    Candidate,
    Experiment,
    Measurement,
    unrefused,
)
from sparseskin.studies.points import StudyError

PRESS = PressFrames("gaussian", (12, 10), 20, "sudden")
PAPER = Candidate(PRESETS["paper"])


def test_points_are_the_product_and_what_is_timed_is_run_by_itself():
    parts = {
        "frames": [PRESS, UntouchedFrames(8, 3)],
        "measurements": [Measurement(3), Measurement(4)],
        "candidates": {"a": PAPER, "raw": Candidate(of="reading")},
        "scores": ("mean_db",),
        "seeds": (0, 1, 2),
    }
    together = Experiment("some", **parts)
    assert len(together.points()) == 2 * 2 * 3
    assert all(set(point["candidates"]) == {"a", "raw"} for point in together.points())
    alone = Experiment("some", timed=True, **parts)
    assert len(alone.points()) == 2 * 2 * 2 * 3
    assert TIMED_ON == "process:1"


def test_all_estimators_of_a_ratio_send_the_same_bytes_to_within_rounding(tmp_path):
    scores = ("n_bytes", "n_contact", "mean_db")
    run = Experiment("all", [PRESS], [Measurement(3)], CANDIDATES, scores).run(tmp_path, "serial")
    rows = unrefused(run).set_index("method")
    assert set(rows.index) == set(CANDIDATES) >= set(SIMPLE)
    assert rows["n_bytes"].astype(float).tolist() == pytest.approx(
        [VALUE_BYTES * 120 / 3] * len(rows), abs=6
    )
    assert rows["n_contact"].nunique() == 1
    every = READINGS | {kind: Candidate(of=kind) for kind in CODECS}
    read = Experiment("read", [PRESS], [Measurement(1)], every, scores).run(tmp_path, "serial")
    assert (unrefused(read)["mean_db"] > 30).all()


def test_a_seed_changes_what_is_random_and_nothing_else(tmp_path):
    chosen = {name: CANDIDATES[name] for name in ("subsample", "lattice")}
    frames = [PressFrames("gaussian", (12, 10), 20, "sudden")]
    rows = Experiment("seeds", frames, [Measurement(4)], chosen, ("psnr_db",), (0, 1)).run(
        tmp_path, "serial"
    )
    assert rows["seed"].tolist() == [0, 0, 1, 1]
    assert len({str(db) for db in rows["psnr_db"]}) == 4


def test_what_does_not_go_together_is_refused_by_name_and_the_others_are_run(tmp_path):
    chosen = {"good": PAPER, "bad": Candidate({**PRESETS["paper"], "iterations": 0})}
    rows = Experiment("some", [PRESS], [Measurement(3)], chosen, ("mean_db",)).run(
        tmp_path, "serial"
    )
    found = rows.set_index("method")
    assert found.loc["good", "refused"] == ""
    assert "iterations = 0" in found.loc["bad", "refused"]
    assert np.isnan(found["mean_db"].astype(float)["bad"])
    with pytest.raises(StudyError, match=r"bad, N/3: .*iterations = 0"):
        unrefused(rows)


def constant(value):
    """Scores of an estimate that is the same everywhere, of 10 loaded and 5 untouched frames."""
    truth = np.zeros((4, 4), np.float32)
    scores = Scores(2.5, None, norm=2.0, total=4.0)
    for k in range(15):
        truth[1:3, 1:3] = float(k >= 5)
        scores.add(Solved(np.full_like(truth, value)), truth)
    return scores


def test_an_estimate_of_nothing_loses_every_contact_and_has_no_ghost():
    found = {name: SCORES[name](constant(0)) for name in SCORES if name != "cpu_share"}
    assert (found["median"], found["vanished"], found["ghosts"]) == (100, 100, 0)
    assert (found["n_contact"], found["n_untouched"]) == (10, 5)
    assert found["touched_mn"] == pytest.approx(1000)
    assert found["flagged"] is None
    assert found["estimate_median"] is None


def test_marks_and_estimates_are_compared_with_the_true_errors():
    scores, truth = Scores(), np.ones((4, 4), np.float32)
    for k in range(20):
        # Right by 5 % in even frames, wrong by 60 % in odd ones; estimated twice that in each 10th.
        off = 0.6 if k % 2 else 0.05
        flagged = k % 2 == 1 and k % 10 != 5
        error = off * (2 if k % 10 == 0 else 1)
        scores.add(Solved((1 + off) * truth, error=error, flagged=flagged), truth)
    found = {name: SCORES[name](scores) for name in SCORES if "flag" in name or "estim" in name}
    assert (SCORES["n_wrong"](scores), SCORES["n_right"](scores)) == (10, 10)
    assert (found["flagged_wrong"], found["flagged_right"], found["flagged"]) == (80, 0, 40)
    assert found["estimate_low"] == pytest.approx(1, abs=1e-4)
    assert found["estimate_median"] == pytest.approx(1, abs=1e-4)
    assert found["estimate_high"] == pytest.approx(2, abs=0.06)


def test_first_frames_of_contacts_are_those_without_one_before():
    scores, zeros = Scores(), np.zeros((4, 4), np.float32)
    for force in (0.0, 1.0, 2.0, 0.0, 2.0):
        scores.add(Solved(zeros), zeros + np.float32(force))
    dbs = [20 * np.log10(2.5 / force) for force in (1.0, 2.0)]
    assert SCORES["first_db"](scores) == pytest.approx(np.mean(dbs), abs=1e-4)
    assert SCORES["mean_db"](Scores()) is None
