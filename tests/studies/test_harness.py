"""Experiments: their points, estimators on the same frames, and their scores."""

import numpy as np
import pytest

from sparseskin.messages.skin import Skin
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.studies.accuracy.experiments import CANDIDATES, READINGS, SIMPLE
from sparseskin.studies.baselines.sampling import CODECS
from sparseskin.studies.evaluate import (
    VALUE_BYTES,
    Reading,
    Scores,
    Solved,
    evaluate,
    make_method,
)
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
    assert (len(alone.points()), TIMED_ON) == (2 * 2 * 2 * 3, "process:1")


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
    assert (rows["seed"].tolist(), len({str(db) for db in rows["psnr_db"]})) == ([0, 0, 1, 1], 4)


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


SHAPE = (8, 8)
TRUTHS = [np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.float32)]
TRUTHS[1][2:4, 2:4] = 1.0
FRAMES = [(truth, truth + np.float32(0.02)) for truth in TRUTHS]


def test_a_reading_is_scored_against_the_closed_form():
    scores = evaluate({"raw": Reading(), "zone": Reading(0.1)}, FRAMES)
    raw, zone = scores["raw"], scores["zone"]
    every_db = 20 * np.log10(2.5 / 0.02)
    assert raw.psnr_db == pytest.approx([every_db, every_db], abs=1e-4)
    assert (raw.contact, raw.contact_db) == ([False, True], raw.psnr_db[1:])
    assert raw.touched == [(pytest.approx(0.02**2, rel=1e-4), 4)]
    # 4 of 64 taxels are off: 12 dB more.
    assert zone.psnr_db == pytest.approx([100.0, every_db + 20 * np.log10(4)], abs=1e-4)


def test_a_method_is_the_solver_on_its_own_measurements():
    chosen = {"solver": "fista", "iterations": 5, "lambda_n": 0.01}
    method = make_method(chosen, SHAPE, 2, seed=3, rows=FIXED)
    phi = make_phi("sbhe", n=64, m=32, seed=3)
    solver = make_solver("fista", phi, make_basis("haar", *SHAPE), iterations=5, lambda_n=0.01)
    scores = evaluate({"fista": method}, FRAMES)["fista"]
    expected = [solver.solve(phi.forward(taxels.reshape(-1))) for _, taxels in FRAMES]
    errors = [psnr_db(forces - truth, 2.5) for forces, truth in zip(expected, TRUTHS, strict=True)]
    assert (scores.psnr_db, scores.n_steps) == (errors, [5, 5])
    assert all(wall_s > 0 for wall_s in scores.wall_s)
    method.reset()
    np.testing.assert_array_equal(method.reconstruct(FRAMES[0][1]).forces, expected[0])


def test_rotating_row_subsets_together_hold_every_row():
    phis = CompressorSettings(rows=ROTATING).phis(Skin(8, 8, 2.5))
    assert [phi.m for phi in phis] == [22, 22, 22]
    method = make_method(PRESETS["skin"], SHAPE, 3, seed=0, rows=ROTATING)
    used = []
    for _, taxels in [*FRAMES, *FRAMES]:
        used.append(method.phi.fingerprint)
        np.testing.assert_array_equal(
            method.measure(taxels), method.phi.forward(taxels.reshape(-1))
        )
        method.reconstruct(taxels)
    assert (len(set(used[:3])), used[3]) == (3, used[0])


def test_missing_taxels_are_not_measured():
    mask = np.ones(SHAPE, np.bool_)
    mask[0] = False
    method = make_method(PRESETS["paper"], SHAPE, 2, seed=0, rows=FIXED, mask=mask)
    taxels = FRAMES[1][1].copy()
    taxels[0] = np.nan
    assert not method.reconstruct(taxels).forces[0].any()
