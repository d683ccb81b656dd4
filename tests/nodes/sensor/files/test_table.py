"""Tables of text: separators, headers, times, the choice of columns, and what is asked for."""

import numpy as np
import pytest

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.file_source import n_taxels, open_file

GRID = np.arange(12.0).reshape(2, 2, 3)


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
    ],
)
def test_a_table_as_programs_write_it_is_read(tmp_path, text, stated, rate_hz):
    source = read(tmp_path, text, **stated)
    np.testing.assert_array_equal(source.frames, GRID)
    assert source.rate_hz == rate_hz
    assert source.stamp_ns[1] == round(1e9 / (rate_hz or 100))
    assert n_taxels(str(tmp_path / "log.csv"), "N", **stated) == 6


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
        ("name\nleft\n", {}, "no column holds numbers; state columns"),
        ("1," + 140_000 * "2", {"n_rows": 1}, "line 1: field larger than field limit"),
    ],
)
def test_what_is_no_table_of_frames_is_refused_in_one_line(tmp_path, text, stated, message):
    with pytest.raises(SourceError, match=message) as caught:
        read(tmp_path, text, **stated)
    assert str(caught.value).startswith(str(tmp_path / "log.csv"))
    assert str(caught.value).isprintable()
