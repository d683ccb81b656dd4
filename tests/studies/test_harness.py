"""Experiments: their points, estimators on the same frames, and their scores."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import FIXED
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.estimates.uncertainty import SCALE
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.accuracy.experiments import CANDIDATES, READINGS, SIMPLE
from sparseskin.studies.baselines.sampling import (
    CODECS,
    NEWEST,
    Codec,
    Filtered,
    Lattice,
    classes,
)
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
    assert len(alone.points()) == 2 * 2 * 2 * 3
    assert TIMED_ON == "process:1"


def test_all_estimators_of_a_ratio_send_the_same_bytes_to_within_rounding(tmp_path):
    scores = ("n_bytes", "n_contact", "mean_db")
    run = Experiment("all", [PRESS], [Measurement(3)], CANDIDATES, scores).run(
        tmp_path, "serial"
    )
    rows = unrefused(run).set_index("method")
    assert set(rows.index) == set(CANDIDATES) >= set(SIMPLE)
    assert rows["n_bytes"].astype(float).tolist() == pytest.approx(
        [VALUE_BYTES * 120 / 3] * len(rows), abs=6
    )
    assert rows["n_contact"].nunique() == 1
    chosen = {name: CANDIDATES[name] for name in ("subsample", "lattice")}
    some = Experiment("seeds", [PRESS], [Measurement(4)], chosen, ("psnr_db",), (0, 1))
    rows = some.run(tmp_path, "serial")
    assert rows["seed"].tolist() == [0, 0, 1, 1]
    assert len({str(db) for db in rows["psnr_db"]}) == 4
    every = READINGS | {kind: Candidate(of=kind) for kind in CODECS}
    read = Experiment("read", [PRESS], [Measurement(1)], every, scores).run(
        tmp_path, "serial"
    )
    assert (unrefused(read)["mean_db"] > 30).all()


def test_what_does_not_go_together_is_refused_by_name_and_the_others_are_run(tmp_path):
    chosen = {"good": PAPER, "bad": Candidate({**PRESETS["paper"], "iterations": 0})}
    rows = Experiment("a", [PRESS], [Measurement(3)], chosen, ("mean_db",)).run(
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
    assert found["median"] == 100
    assert found["vanished"] == 100
    assert found["ghosts"] == 0
    assert found["n_contact"] == 10
    assert found["n_untouched"] == 5
    assert found["touched_mn"] == pytest.approx(1000)
    assert found["flagged"] is None
    assert found["estimate_median"] is None


def test_marks_and_estimates_are_compared_with_the_true_errors():
    scores = Scores()
    truth = np.ones((4, 4), np.float32)
    for k in range(20):
        # Right by 5 % in even frames, wrong by 60 % in odd ones; estimated twice that in each 10th.
        off = 0.6 if k % 2 else 0.05
        flagged = k % 2 == 1 and k % 10 != 5
        error = off * (2 if k % 10 == 0 else 1)
        scores.add(Solved((1 + off) * truth, error=error, flagged=flagged), truth)
    found = {
        name: SCORES[name](scores)
        for name in SCORES
        if "flag" in name or "estim" in name
    }
    assert SCORES["n_wrong"](scores) == 10
    assert SCORES["n_right"](scores) == 10
    assert found["flagged_wrong"] == 80
    assert found["flagged_right"] == 0
    assert found["flagged"] == 40
    assert found["estimate_low"] == pytest.approx(1, abs=1e-4)
    assert found["estimate_median"] == pytest.approx(1, abs=1e-4)
    assert found["estimate_high"] == pytest.approx(2, abs=0.06)


@given(st.floats(0.01, 100), st.floats(-0.9, 2))
def test_bands_of_the_true_error_do_not_depend_on_the_stated_one(stated, off):
    assume(abs(off) > 1e-3)
    # Where all taxels are off alike, a deviation is `SCALE` RMS errors, and a band 1.645 of these.
    band = SCALE * 1.645
    assume(abs(stated * band - 1) > 1e-3)
    truth = np.ones((4, 4), np.float32)
    scores = Scores()
    scores.add(Solved((1 + off) * truth, error=stated * abs(off)), truth)
    assert SCORES["held_by_true"](scores) == 100
    assert SCORES["held"](scores) == 100 * (stated * band > 1)


def test_first_frames_of_contacts_are_those_without_one_before():
    scores = Scores()
    zeros = np.zeros((4, 4), np.float32)
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
    raw = scores["raw"]
    zone = scores["zone"]
    every_db = 20 * np.log10(2.5 / 0.02)
    assert raw.psnr_db == pytest.approx([every_db, every_db], abs=1e-4)
    assert raw.contact == [False, True]
    assert raw.contact_db == raw.psnr_db[1:]
    assert raw.touched == [(pytest.approx(0.02**2, rel=1e-4), 4)]
    # 4 of 64 taxels are off: 12 dB more.
    assert zone.psnr_db == pytest.approx([100.0, every_db + 20 * np.log10(4)], abs=1e-4)


def test_a_method_is_the_solver_on_its_own_measurements():
    chosen = {"solver": "fista", "iterations": 5, "lambda_n": 0.01}
    method = make_method(chosen, SHAPE, 2, seed=3, rows=FIXED)
    phi = make_phi("sbhe", n=64, m=32, seed=3)
    solver = make_solver(
        "fista", phi, make_basis("haar", *SHAPE), iterations=5, lambda_n=0.01
    )
    scores = evaluate({"fista": method}, FRAMES)["fista"]
    expected = [solver.solve(phi.forward(taxels.reshape(-1))) for _, taxels in FRAMES]
    errors = [
        psnr_db(forces - truth, 2.5)
        for forces, truth in zip(expected, TRUTHS, strict=True)
    ]
    assert scores.psnr_db == errors
    assert scores.n_steps == [5, 5]
    assert all(wall_s > 0 for wall_s in scores.wall_s)
    method.reset()
    np.testing.assert_array_equal(method.reconstruct(FRAMES[0][1]).forces, expected[0])


GRID = (12, 10)
EVERY = np.ones(GRID, np.bool_)


def press(row):
    """A smooth press at a row."""
    i, j = np.indices(GRID)
    frame = 50 * np.exp(-((i - row) ** 2 + (j - 5) ** 2) / 6)
    return np.where(frame > 1, frame, 0).astype(np.float32)


def still(force_n, n=40):
    truth = np.full((8, 8), force_n, dtype=np.float32)
    rng = np.random.default_rng(0)
    return [NoiseModel().apply(truth, rng) for _ in range(n)]


@pytest.mark.parametrize("k", [2, 3, 16])
@pytest.mark.parametrize("shape", [(1, 16), (31, 11)])
def test_classes_hold_every_taxel_once_and_are_of_equal_density(shape, k):
    mask = np.ones(shape, dtype=np.bool_)
    mask[0, :2] = False
    members = classes(mask, k)
    assert np.array_equal(np.sort(np.concatenate(members)), np.flatnonzero(mask))
    assert len(members) == k
    assert max(one.size for one in members) <= mask.size / k + max(shape)


def test_the_lattice_reproduces_a_plane_and_reads_no_cell_without_a_taxel():
    i, j = np.indices((16, 16))
    plane = (1 + 2 * i + 3 * j).astype(np.float32)
    solved = Lattice(np.ones((16, 16), dtype=np.bool_), 4).reconstruct(plane)
    assert solved.n_bytes == 64 * VALUE_BYTES
    assert np.abs((solved.forces - plane)[3:-3, 3:-3]).max() < 1e-3
    mask = np.zeros((8, 8), dtype=np.bool_)
    mask[::2, ::2] = True
    taxels = np.where(mask, np.float32(3), np.float32(np.nan))
    for ratio in (3, 4, 8):
        solved = Lattice(mask, ratio).reconstruct(taxels)
        assert solved.n_bytes <= VALUE_BYTES * -(-16 // ratio)
        assert (solved.forces == np.where(mask, 3, 0)).all()


def test_the_filter_halves_the_noise_and_follows_a_jump_at_once():
    frames = still(1.25)
    kept = Filtered(NoiseModel())
    last = [kept.reconstruct(frame).forces for frame in frames][-1]
    # Of a running mean of weight w, the variance is w / (2 - w).
    expected = np.std(frames[-1]) * np.sqrt(NEWEST / (2 - NEWEST))
    assert np.std(last) == pytest.approx(expected, rel=0.3)
    kept = Filtered(NoiseModel())
    for frame in still(0.0):
        assert kept.reconstruct(frame).forces.max() < 0.1
    pressed = still(1.0, 1)[0]
    before = pressed.copy()
    np.testing.assert_allclose(kept.reconstruct(pressed).forces, pressed, rtol=1e-6)
    np.testing.assert_array_equal(pressed, before)


@pytest.mark.parametrize("kind", CODECS)
def test_codecs_keep_eight_bits_and_state_their_size(kind):
    codec = Codec(EVERY, 50.0, kind)
    for frame in (press(5), press(5.5), np.zeros(GRID, np.float32)):
        assert (
            np.abs(codec.reconstruct(frame).forces - frame).max() <= 0.5001 * 50 / 255
        )
    codec.reconstruct(np.zeros(GRID, np.float32))
    assert codec.reconstruct(np.zeros(GRID, np.float32)).n_bytes < 30
    # Touched taxels cost a byte each, and a bit a taxel.
    frame = press(5)
    assert (
        kind != "touched"
        or codec.reconstruct(frame).n_bytes == np.count_nonzero(frame) + 15
    )
