"""Readings of recordings that are not valid: refused, or treated as settings say."""

import numpy as np
import pytest

from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.node import Context
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.files.recording import Policy
from sparseskin.nodes.sensor.missing import MissingReadings
from sparseskin.nodes.sensor.node import Sensor, SensorSettings

BAD = np.array([[[1, 2], [3, 4]], [[np.nan, -1], [5, np.inf]], [[2, 2], [-3, 1]]], np.float32)


def treated(policy, folder):
    np.save(folder / "a.npy", BAD)
    return open_file(folder / "a.npy", f_max=10.0, policy=policy)


@pytest.mark.parametrize(
    ("nan", "negative", "expected", "mask"),
    [
        ("zero", "zero", [[1, 2, 3, 4], [0, 0, 5, 0], [2, 2, 0, 1]], None),
        ("hold", "zero", [[1, 2, 3, 4], [1, 0, 5, 4], [2, 2, 0, 1]], None),
        ("hold", "offset", [[4, 5, 6, 7], [4, 2, 8, 7], [5, 5, 0, 4]], None),
        ("mask", "zero", [[1, 2, 3, 4], [2.5, 0, 5, 2.5], [2, 2, 0, 1]], None),
        ("zero", "mask", [[1, 0, 0, 4], None, [2, 0, 0, 1]], [True, False, False, True]),
    ],
)
def test_invalid_readings_become_what_the_settings_say(tmp_path, nan, negative, expected, mask):
    source = treated(Policy(nan, negative), tmp_path)
    readings = MissingReadings(nan, source.skin, learns=False)
    filled = [readings.fill(frame, 0) for frame in source.frames]
    assert [found and found[0].ravel().tolist() for found in filled] == expected
    assert (source.treated.not_finite, source.treated.negative) == (2, 2)
    held = None if source.skin.mask is None else source.skin.mask.ravel().tolist()
    assert held == mask


def test_missing_and_negative_cells_of_a_csv_are_treated_too(tmp_path):
    (tmp_path / "a.csv").write_text("1,,NaN,4\n-2,5,6,7\n")
    options = {"n_rows": 2, "n_cols": 2, "unit": "N"}
    source = open_file(tmp_path / "a.csv", **options, policy=Policy("zero", "offset"))
    found = np.nan_to_num(source.frames, nan=-1).reshape(2, 4)
    assert found.tolist() == [[3, -1, -1, 6], [0, 7, 8, 9]]
    assert source.treated.counts() == {
        "not_finite": 2,
        "negative": 1,
        "masked_taxels": 0,
        "offset": -2.0,
    }
    with pytest.raises(SourceError, match="line 1, column 2: '' is not a number"):
        open_file(tmp_path / "a.csv", **options)


def test_a_sensor_counts_invalid_readings_in_its_log_and_report(tmp_path):
    np.save(tmp_path / "a.npy", BAD)
    lines = []
    chosen = SensorSettings(source=f"file:{tmp_path / 'a.npy'}", nan="hold", negative="offset")
    sensor = Sensor(chosen, Context("sensor", ManualClock(0), lines.append))
    list(sensor.start())
    assert lines[2:] == [
        "2 readings of the file are not finite: replaced by the last ones",
        "2 readings of the file are below 0: -3 N subtracted from all readings",
    ]
    counts = {"not_finite": 2, "negative": 2, "masked_taxels": 0, "offset": -3.0}
    assert sensor.report()["invalid"] == counts
