"""Constants of the default solver, halved and doubled: their values, and what they change."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from sparseskin.nodes.reconstructor.skin.tuning import SkinTuning
from sparseskin.studies.accuracy import constants, experiments
from sparseskin.studies.accuracy.experiments import Runs


def test_every_constant_has_a_candidate_halved_and_doubled():
    assert set(constants.PARTS + constants.GROWTHS) <= set(constants.VALUES)
    tunings = [one.settings.get("tuning", {}) for one in constants.candidates().values()]
    for name in vars(SkinTuning()):
        low, high = (tuning[name] for tuning in tunings if name in tuning)
        assert low < getattr(SkinTuning(), name) < high


def test_a_changed_constant_changes_the_scores_and_has_a_row(monkeypatch, tmp_path):
    monkeypatch.setattr(constants, "VALUES", {"damping": 0.5, "averaged": 3})
    for name, value in {"SIDES": (12,), "QUICK_BODIES": ("peg",), "PRESS_FRAMES": 30}.items():
        monkeypatch.setattr(experiments, name, value)
    i, j = np.indices((12, 12))
    press = 50 * np.exp(-((i - 5) ** 2 + (j - 5) ** 2) / 6)
    frames = press * np.linspace(0, 1, 30)[:, None, None]
    np.save(tmp_path / "press.npy", frames.astype(np.float32))
    rows = Runs(tmp_path, "serial", True, (0,), tmp_path).constants(constants.candidates())
    presses, recordings = rows[rows["path"].isna()], rows[rows["path"].notna()]
    assert recordings.groupby("rows")["median"].nunique().eq(5).all()
    assert presses.groupby(["course", "rows"])["mean_db"].nunique().eq(5).all()
    table = constants.table(rows).set_index("constant")
    assert list(table.index) == [constants.UNCHANGED, "damping = 0.5", "averaged = 3"]
    db = presses[presses["course"] == "moving"].groupby("method")["mean_db"].mean()
    low, high = (db[f"damping x {times}"] - db[constants.UNCHANGED] for times in ("0.5", "2"))
    assert table.loc["damping = 0.5", "moving, dB"] == f"{low:+.2f} / {high:+.2f}"
    medians = recordings[recordings["rows"] == "fixed"].set_index("method")["median"]
    by = 100 * (medians["averaged x 2"] / medians[constants.UNCHANGED] - 1)
    assert table.loc["averaged = 3", "error, fixed rows, %"].endswith(f" / {by:+.1f}")
