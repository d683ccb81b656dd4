"""Vendors' exports: what shows at their begin, and what becomes of damaged ones."""

import numpy as np
import pytest
from damaged import refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from vendor_texts import emed_text, tekscan_text, xsensor_text

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.file_source import n_taxels, open_file

TEXTS = {
    "foot.lst": emed_text(),
    "hand.asf": tekscan_text().rstrip("\n"),
    "hand.csv": tekscan_text(),
    "sole.csv": xsensor_text(),
}
#: Pieces that mean something in one of them.
PIECES = ["", "9", "-", "\t", ",", "\n", "\f", "\xb2", "nan", "SENSELS\n", "FRAME,"]


def opened(folder, name, text):
    """A file with a text; None where it is refused, in one line."""
    path = folder / name
    path.write_bytes(text.encode("latin-1"))
    f_max = 100.0 if name in ("foot.lst", "sole.csv") else None
    found = []
    assert refusal(lambda: found.append(open_file(path, f_max=f_max))).isprintable()
    return found[0] if found else None


def test_the_number_of_taxels_shows_at_the_begin(tmp_path):
    for name, n in (("foot.lst", 12), ("hand.asf", 4)):
        (tmp_path / name).write_bytes(TEXTS[name].encode("latin-1"))
        assert n_taxels(str(tmp_path / name)) == n


@pytest.mark.parametrize("name", TEXTS)
def test_windows_line_ends_and_commas_of_a_spreadsheet_are_read_the_same(name, tmp_path):
    whole = opened(tmp_path, name, TEXTS[name])
    texts = [TEXTS[name].replace("\n", "\r\n")]
    if name == "hand.asf":
        texts.append(TEXTS[name].replace("\n", ",,,\n"))
    for text in texts:
        again = opened(tmp_path, name, text)
        np.testing.assert_array_equal(again.frames, whole.frames)


@pytest.mark.parametrize("name", ["foot.lst", "hand.asf", "sole.csv"])
def test_a_file_cut_anywhere_is_refused_or_loses_whole_frames(name, tmp_path):
    text = TEXTS[name]
    whole = opened(tmp_path, name, text)
    n_read = 0
    for end in range(1, len(text), 5):
        if (cut := opened(tmp_path, name, text[:end])) is not None:
            np.testing.assert_array_equal(cut.frames, whole.frames[: len(cut.frames)])
            n_read += 1
    assert n_read < len(text) // 5
    assert name != "hand.asf" or n_read == 0  # it has an end mark


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(list(TEXTS)), data=st.data())
def test_damaged_files_give_what_a_source_promises_or_are_refused(name, data, tmp_path):
    text = TEXTS[name]
    if data.draw(st.booleans()):
        text = data.draw(st.binary(max_size=300)).decode("latin-1")
    for _ in range(data.draw(st.integers(1, 4)) if text else 0):
        start = data.draw(st.integers(0, len(text) - 1)) if text else 0
        new = data.draw(
            st.sampled_from(PIECES) | st.binary(max_size=3).map(lambda b: b.decode("latin-1"))
        )
        text = text[:start] + new + text[start + data.draw(st.integers(0, 6)) :]
    source = opened(tmp_path, name, text)
    if source is None:
        return
    assert np.isfinite(source.frames).all()
    assert source.frames.min() >= 0
    assert source.frames.max() <= np.float32(source.skin.f_max)
    assert (np.diff([stamp for stamp, _ in source]) > 0).all()


BROKEN = {
    "foot.lst": [
        ("Pict-No.: 2", "Pict-No.: 3", "line .*: frame 3 comes where frame 2 should"),
        ("\t100.00\t", "\t-100.00\t", "frame 2, row 2, column 1: '-100.00' is below 0"),
        ("\t100.00\t", "\t10.00\t", "Force is 3 N, but the readings add up to 0.75 N"),
        ("\t100.00\t", "\t", "frame 2 has 3 cells in this row, its header row 4"),
        ("\t2\t3\tForce", "\t3\t4\tForce", "column label: 4 is outside 1..3"),
        ("\n4\t", "\n3\t", "row 3 comes after row 3"),
        ("Matrix: 3x4", "Matrx: 3x4", "states no 'Matrix: COLUMNSxROWS'"),
        ("10.0 ms", "0.0 ms", "'0.0' is outside"),
        ("Pict-No.: ", "Picture ", "no page with a line 'Pict-No.: 1'"),
    ],
    "hand.csv": [
        ("Frame 2", "Frame 3", "line 17: frame 3 comes where frame 2 should"),
        ("END_FRAME 3", "END_FRAME 4", "the last frame is 3, but END_FRAME is 4"),
        ("Raw Sum=,,12", "Raw Sum=,,13", "Raw Sum 13, but its cells add up to 12"),
        ("B,0,5", "0,0,5", "frame 2 has its 'B' cells .* elsewhere"),
        ("B,0,5", "B,0", "line 18, frame 2: row 0 has 2 cells, COLS is 3"),
        (", 0.21,", ", 0.05,", "the time of frame 3 is before"),
        ("UNITS raw\n", "", "the header states no UNITS"),
        ("MOVIE", "FRAME", "DATA_TYPE 'FRAME'; allowed is MOVIE"),
        ("0.127 centimeters", "0.127 feet", "unit 'feet'; allowed are mm"),
        ("\n@@", "", "cut short, its end mark '@@' is missing"),
    ],
    "sole.csv": [
        ("FRAME,", "PICTURE,", "holds no line FRAME"),
        ("Rows,3", "", "frame 1464 states no Rows"),
        ("Columns,4", "Columns,3", "row 0 has 4 cells, Columns is 3"),
        ("7.25", "72.5", "states a peak of 20, but its largest reading is 72.5"),
        ("08:21:17.995", "08:21:17.905", "time of frame 2 is before"),
        ("SENSOR,LF", "SENSOR,LX", "frame 1465 is 3 x 4 of sensor 'LF', the first one"),
        ("SENSELS", "SENSELLS", "frame 1464 has no line SENSELS"),
    ],
}
"""Of each file what is replaced in its text, by what, and the line that refuses it."""


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [(name, *row) for name, rows in BROKEN.items() for row in rows],
)
def test_a_broken_file_is_refused_with_its_line(name, old, new, message, tmp_path):
    text = TEXTS[name]
    assert old in text
    times = 1 if name == "sole.csv" and old != "FRAME," else -1
    (tmp_path / name).write_bytes(text.replace(old, new, times).encode("latin-1"))
    with pytest.raises(SourceError, match=message) as caught:
        open_file(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
