"""Tables of frames, and invalid readings of any file."""

import contextlib
import re
import tracemalloc
import zipfile

import numpy as np
import pytest
from damaged import npy, npz, refusal

from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.node import Context
from sparseskin.nodes.numerics import array_files
from sparseskin.nodes.numerics.array_files import read_npy, read_npz
from sparseskin.nodes.sensor.files.file_source import n_taxels, open_file
from sparseskin.nodes.sensor.files.recording import Policy
from sparseskin.nodes.sensor.missing import MissingReadings
from sparseskin.nodes.sensor.node import Sensor, SensorSettings

GRID = np.arange(12.0).reshape(2, 2, 3)
ROW = {"n_rows": 1, "n_cols": 2}


def read(folder, text, **stated):
    (folder / "log.csv").write_text(text)
    return open_file(folder / "log.csv", **{"unit": "N", **stated})


@pytest.mark.parametrize(
    ("text", "stated", "rate_hz"),
    [
        ("# n\n0,1,2,3,4,5\r\n\r\n6, 7 ,8,9,10,1.1e1\n", {"n_rows": 2}, None),
        ("0 1 2 3 4 5\n6 7 8 9 10 11\n", {"n_cols": 3}, None),
        ("0;1,0;2;3;4;5\n6;7;8;9;10;11\n", {"n_rows": 2, "n_cols": 3}, None),
        ("t,r0c0,r0c1,r0c2,r1c0,r1c1,r1c2\n5,0,1,2,3,4,5\n25,6,7,8,9,10,11\n", {}, 50),
        ("r1c0,r1c1,r1c2,r0c0,r0c1,r0c2\n3,4,5,0,1,2\n9,10,11,6,7,8\n", {}, None),
        (
            "frame,time [s],s0,s1,s2,s3,s4,s5,hand\n"
            "0,0.50,0,1,2,3,4,5,left\n1,0.75,6,7,8,9,10,11,left\n",
            {"n_rows": 2},
            4,
        ),
        (
            "2026-11-03T09:30:00.5Z,0,1,2,3,4,5\n2026-11-03T10:30:00.6+01:00,6,7,8,9,10,11\n",
            {"n_rows": 2},
            10,
        ),
        ("7,0,1,2,3,4,5\n17,6,7,8,9,10,11\n", {"n_rows": 2, "n_cols": 3}, 100),
        ("0,0,1,2,3,4,5\n1,6,7,8,9,10,11\n", {"n_rows": 2, "n_cols": 3}, None),
        ("1790000000,0,1,2,3,4,5\n1790000002,6,7,8,9,10,11\n", {"n_rows": 2, "n_cols": 3}, 0.5),
        (
            "a,when,x0,x1,x2,x3,x4,x5\n9,4,0,1,2,3,4,5\n9,8,6,7,8,9,10,11\n",
            {"n_rows": 2, "columns": "time_us=when,x*"},
            250_000,
        ),
        (
            ",0,1,2,3,4,5,6,7\n0,0,1,2,3,4,5,9,9\n1,6,7,8,9,10,11,9,9\n",
            {"n_rows": 2, "columns": "2-7"},
            None,
        ),
        ("9,0,1,2,3,4,5\n9,6,7,8,9,10,11\n", {"n_rows": 2, "columns": "2-7"}, None),
        ("9,0,1,2,3,4,5,\n99,6,7,8,9,10,11,\n", {"n_rows": 2, "columns": "time_s=1,2-7"}, 1 / 90),
    ],
)
def test_a_table_as_programs_write_it_is_read(tmp_path, text, stated, rate_hz):
    source = read(tmp_path, text, **stated)
    np.testing.assert_array_equal(source.frames, GRID)
    assert (source.rate_hz, source.stamp_ns[1]) == (rate_hz, round(1e9 / (rate_hz or 100)))
    assert n_taxels(str(tmp_path / "log.csv"), "N", **stated) == 6
    assert ("left out: column " in str(source.notes)) == (text[0] in "af,9")


@pytest.mark.parametrize(
    ("text", "stated", "message"),
    [
        ("1,2,3,4\n", {"unit": None}, "add n_rows=2 n_cols=2 unit=N rate_hz=100$"),
        ("t,a,b,c\n1,2,3,4\n", {"unit": None}, "shape .*, unit .*; add n_rows=1 n_cols=3 unit=N$"),
        ("1,2,3,4\n", {"n_rows": 2, "n_cols": 3}, "2 x 3 needs 6"),
        ("1,2,3,4\n1,2,3\n", {"n_rows": 2}, "line 2: holds 3 cells, the first line 4"),
        ("a1,a2\n3,-4\n", {"n_rows": 1}, "frame 0, row 0, column 1: -4 is below 0"),
        ("a1,a2\n3,4\n5,b\n", {"n_rows": 1}, "line 3, column 'a2': 'b' is not a number"),
        ("\n# only\n", {"n_rows": 1}, "holds no frame"),
        ("t,a\n2,1\n1,1\n", {"n_rows": 1}, "time of frame 2 is before"),
        ("t,a\n2,1\nsoon,1\n", {"n_rows": 1}, "line 3, time: 'soon' is not a number"),
        ("a,b\n1,2\n", {"columns": "c*"}, "columns: 'c.' is none of 2 columns .'a', 'b', "),
        ("a,b\n1,2\n", {"columns": "2-9"}, "'2-9' is none of 2 columns"),
        ("name\nleft\n", {}, "no column holds numbers; state columns.*a line of units with #$"),
        ("5,a,1,2\n6,a,1,2\n", ROW, "3 columns hold numbers, .* = 2; add columns=time=1,3-4$"),
        ("5,1,2,\n", ROW, "3 columns hold numbers, .* = 2; add columns=time=1,2-3$"),
        ("1,2,\n", ROW, "line 1, column 3: '' is not .*, or zero or mask, or columns=1-2$"),
        ("1,\0", ROW, "not a text table in UTF-8"),
        ("1,2\r3,4", ROW, "line 1: no line of a table of text: .* a line end within"),
        ("1," + 140_000 * "2", {"n_rows": 1}, "line 1: no line of a table of text: field larger"),
    ],
)
def test_what_is_no_table_of_frames_is_refused_in_one_line(tmp_path, text, stated, message):
    shown = refusal(lambda: read(tmp_path, text, **stated), SourceError)
    assert re.match(f"{tmp_path / 'log.csv'}.*{message}", shown)


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
    counts = {"not_finite": 2, "negative": 1, "masked_taxels": 0, "offset": -2.0}
    assert source.treated.counts() == counts
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


MB = 1_000_000


@contextlib.contextmanager
def peak_below(n_bytes):
    """No more memory than that is allocated within."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < n_bytes
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("dtype", ["u1", ">f4", "?", "<U3"])
@pytest.mark.parametrize("shape", [(), (2, 3, 4), (0, 4, 4)])
def test_arrays_are_read_as_numpy_wrote_them(shape, dtype):
    array = np.arange(np.prod(shape, dtype=int)).astype(dtype).reshape(shape)
    for written in (array, np.asfortranarray(array)):
        np.testing.assert_array_equal(read_npy(npy(written)), written)
        found = read_npz(npz(a=written, b=written), lambda names: ["b"])
        assert list(found) == ["b"]
        np.testing.assert_array_equal(found["b"], written)


def test_an_archive_that_would_grow_too_far_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr(array_files, "MAX_GROWN_BYTES", MB)
    path = tmp_path / "bomb.npz"
    path.write_bytes(npz(forces=np.zeros((40_000, 32, 32), np.uint8)))
    assert path.stat().st_size < MB / 10
    with peak_below(MB), pytest.raises(SourceError, match=r"bomb\.npz: its arrays would have 409"):
        open_file(path)


def test_headers_of_arrays_are_not_believed(tmp_path):
    head = npy(np.zeros((1, 4, 4)))[:128].replace(b"(1, 4, 4)", b"(1000000, 400, 4)")[:128]
    path = tmp_path / "lies.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("forces.npy", head + bytes(64))
    with peak_below(MB), pytest.raises(SourceError, match=r"array 'forces': its header states 10"):
        open_file(path)
    path = tmp_path / "true.npy"
    path.write_bytes(npy(np.ones((1, 8, 8))).replace(b"(1, 8, 8), }   ", b"(True, 8, 8), }"))
    with pytest.raises(SourceError, match=r"true\.npy: not a readable NumPy file"):
        open_file(path)


def test_a_recording_of_bytes_takes_the_memory_of_its_frames_and_no_more(tmp_path):
    path = tmp_path / "bytes.npy"
    np.save(path, np.ones((4000, 32, 32), np.uint8))
    # The file, its frames in float32, and a part that is checked.
    with peak_below(path.stat().st_size * (1 + 4) + 12 * MB):
        assert open_file(path).n_frames == 4000
