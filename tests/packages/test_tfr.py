"""A file format of another package, installed as pip installs it."""

import json

import numpy as np
import pytest
from installed import installed

import sparseskin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.format import suffixes

HEAD = {"format": "tfr", "rows": 3, "cols": 4, "unit": "N", "rate_hz": 50.0}
FRAMES = np.arange(5 * 12, dtype="<f4").reshape(5, 3, 4) / 100
DATA = FRAMES.tobytes()


@pytest.fixture(autouse=True)
def tfr(tmp_path, monkeypatch):
    suffixes.cache_clear()
    with installed("sparseskin_tfr", tmp_path, monkeypatch):
        yield
    suffixes.cache_clear()


def written(folder, data=DATA, **changes):
    path = folder / "press.tfr"
    path.write_bytes(json.dumps(HEAD | changes).encode() + b"\n" + data)
    return str(path)


def test_its_frames_are_read_with_unit_and_rate(tmp_path):
    recording = sparseskin.read_recording(written(tmp_path))
    np.testing.assert_array_equal(recording["forces"], FRAMES)
    assert recording["unit"] == "N"
    assert recording["rate_hz"] == 50.0


def test_its_suffix_is_listed_among_those_that_are_read():
    assert suffixes()[".tfr"] == "tactile frames"


@pytest.mark.parametrize(
    ("data", "changes", "fault"),
    [
        (DATA[:-1], {}, "239 bytes behind line 1; a frame has 48"),
        (b"", {}, "0 bytes behind line 1; a frame has 48"),
        (DATA, {"rows": 0}, r"line 1: rows = '0'; expected 1\.\.4096"),
        (DATA, {"rate_hz": -1}, "line 1: rate_hz = '-1'"),
        ((FRAMES - 1).tobytes(), {}, "a reading is negative, or no finite number"),
    ],
)
def test_a_malformed_file_is_refused_with_the_place(tmp_path, data, changes, fault):
    with pytest.raises(SourceError, match=fault):
        sparseskin.read_recording(written(tmp_path, data, **changes))
