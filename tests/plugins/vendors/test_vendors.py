"""Files of emed, Tekscan and XSENSOR: real ones, those written here, cut and damaged ones."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from damaged import refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from vendor_texts import EMED_KPA, XSENSOR_FRAMES, emed_text, tekscan_text, xsensor_text

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.file_source import n_taxels, open_file
from sparseskin.nodes.sensor.layout.layout import Layout

FOLDER = Path(
    os.environ.get("SPARSESKIN_RECORDINGS")
    or Path(__file__).resolve().parents[2] / "shared" / "recordings"
)
"""SPARSESKIN_RECORDINGS, or else the folder ../shared/recordings beside the repository."""


def recording(name: str) -> Path:
    """Return the path of a recording, or skip the test."""
    path = FOLDER / name
    if not path.is_file():
        pytest.skip(
            f"{name} is not in the folder of recordings (SPARSESKIN_RECORDINGS)"
        )
    return path


def frames_of(source):
    return np.stack([forces for _, forces in source])


def stamps_of(source):
    return [stamp for stamp, _ in source]


@pytest.fixture
def opened(tmp_path):
    """Write a text to a file of the given name and open it."""

    def write_and_open(name, text, **stated):
        path = tmp_path / name
        path.write_bytes(text.encode("latin-1"))
        return open_file(path, Layout(**stated))

    return write_and_open


class TestRealEmed:
    def test_size_rate_range_and_pitch(self):
        source = open_file(recording("emed_test.lst"))
        frames = frames_of(source)
        assert frames.shape == (106, 95, 64)
        assert frames.dtype == np.float32
        assert source.n_frames == 106
        assert source.rate_hz == pytest.approx(100.0)
        assert source.skin.unit == "N"
        assert source.skin.f_max == pytest.approx(9.25)
        assert frames.max() == np.float32(9.25)
        assert source.skin.pitch_m == pytest.approx(0.005)
        assert source.skin.mask is None
        assert source.delivers == "taxels"
        assert stamps_of(source) == [k * 10_000_000 for k in range(106)]

    def test_force_column_and_row_of_the_file_match_the_frames(self):
        """Read with nothing of the parser: labels are places counted from 1, sums in newtons."""
        path = recording("emed_test.lst")
        frames = frames_of(open_file(path)).astype(np.float64)
        frame = -1
        columns = []
        n_compared = 0
        for line in path.read_bytes().decode("latin-1").split("\n"):
            cells = line.split("\t")
            if cells[-1] == "Force":
                frame += 1
                columns = [int(label) - 1 for label in cells[1:-1]]
            elif cells[0] == "Force":
                of_columns = frames[frame][:, columns].sum(axis=0)
                stated = [float(cell) for cell in cells[1:-1]]
                np.testing.assert_allclose(of_columns, stated, rtol=0, atol=0.0051)
                assert frames[frame].sum() == pytest.approx(
                    float(cells[-1]), abs=0.0051
                )
            elif cells[0].isdigit():
                row = int(cells[0]) - 1
                assert frames[frame][row].sum() == pytest.approx(
                    float(cells[-1]), abs=0.0051
                )
                n_compared += 1
        assert frame == 105
        assert n_compared == 106 * 54


class TestRealTekscan:
    def test_size_rate_range_unit_pitch_mask_and_stamps(self):
        source = open_file(recording("iscan_test.csv"))
        frames = frames_of(source)
        stamps = stamps_of(source)
        mask = source.skin.mask
        assert frames.shape == (309, 28, 28)
        assert source.rate_hz == pytest.approx(10.0)
        assert source.skin.unit == "raw"
        assert frames.min() == 0
        assert frames.max() == 100
        assert source.skin.f_max == 100.0
        assert source.skin.pitch_m == pytest.approx(0.00127)
        assert source.skin.n_taxels == 484 == 4 * 11 * 11
        np.testing.assert_array_equal(np.unique(mask.sum(axis=0)), [0, 22])
        assert not frames[:, ~mask].any()
        # The times that the file gives.
        assert stamps[3:6] == [300_000_000, 400_000_000, 510_000_000]
        assert stamps[-1] == 31_100_000_000

    def test_frames_add_up_to_the_raw_sums(self):
        path = recording("iscan_test.csv")
        sums = [
            int(line.rpartition(",")[2])
            for line in path.read_text().splitlines()
            if line.startswith("Frame ")
        ]
        np.testing.assert_array_equal(frames_of(open_file(path)).sum(axis=(1, 2)), sums)

    def test_the_example_of_the_package_is_this_recording(self):
        whole = open_file(recording("iscan_test.csv"))
        example = open_file("example:fingers")
        np.testing.assert_array_equal(example.frames, whole.frames)
        np.testing.assert_array_equal(example.stamp_ns, whole.stamp_ns)
        assert example.skin.unit == whole.skin.unit


class TestEmed:
    def test_touched_cells_land_on_the_full_matrix_in_newtons(self, opened):
        source = opened("foot.lst", emed_text())
        frames = frames_of(source)
        assert frames.shape == (2, 4, 3)
        np.testing.assert_allclose(frames[:, 1:, 1:], 0.025 * np.array(EMED_KPA))
        assert not frames[:, 0].any()
        assert not frames[:, :, 0].any()
        assert source.skin.f_max == pytest.approx(2.5)  # the page of peaks is no frame
        assert source.skin.unit == "N"
        assert source.rate_hz == 100.0
        assert stamps_of(source) == [0, 10_000_000]
        # Oblong sensors have no pitch; the square of their area is written either way.
        text = (
            emed_text()
            .replace("0.500x0.500", "0.500x0.400")
            .replace("cm\xb2", "cm\xc2\xb2")
        )
        skin = opened("oblong.lst", text).skin
        assert skin.pitch_m is None
        assert skin.f_max == pytest.approx(2.5)


class TestTekscan:
    def test_cells_marked_b_are_masked_and_not_readings(self, opened):
        source = opened("HAND.ASF", tekscan_text())
        np.testing.assert_array_equal(
            source.skin.mask, [[False, True, True], [True, True, False]]
        )
        np.testing.assert_array_equal(
            frames_of(source),
            [[[0, 1, 2], [0, 3, 0]], [[0, 0, 5], [7, 0, 0]], [[0, 0, 0], [0, 9, 0]]],
        )
        assert source.skin.f_max == 9.0
        assert source.skin.unit == "raw"
        assert source.rate_hz == 10.0
        assert stamps_of(source) == [0, 100_000_000, 210_000_000]
        equal = opened("hand.csv", tekscan_text(times=("0", "0.01", "0.01")))
        assert stamps_of(equal) == [0, 100_000_000, 200_000_000]  # by the stated period

    @pytest.mark.parametrize(
        ("rows", "cols", "pitch_m"),
        [("0.05 inches", "0.127 CM", 0.00127), ("2.5 mm", "1.25 mm", None)],
    )
    def test_the_pitch_is_the_one_spacing(self, opened, rows, cols, pitch_m):
        text = tekscan_text().replace(
            "ROW_SPACING 0.127 centimeters", f"ROW_SPACING {rows}"
        )
        text = text.replace("COL_SPACING 0.127 centimeters", f"COL_SPACING {cols}")
        found = opened("hand.csv", text).skin.pitch_m
        assert found == (None if pitch_m is None else pytest.approx(pitch_m))

    def test_calibrated_units_are_kept_and_their_raw_sum_is_not_compared(self, opened):
        source = opened(
            "hand.csv", tekscan_text(unit="kPa").replace("B,0,5", "B,0,5.5")
        )
        assert source.skin.unit == "kPa"
        assert frames_of(source)[1, 0, 2] == np.float32(5.5)


def test_a_recording_of_an_insole_has_the_left_foot_of_the_file():
    source = open_file(recording("xsensor_L.csv"))
    assert source.frames.shape == (101, 31, 11)
    assert source.skin.unit == "mmHg"
    assert source.skin.f_max == pytest.approx(2957.46)
    assert source.skin.pitch_m == pytest.approx(0.0086)
    assert source.skin.n_taxels == 228
    # 101 frames in 1.331 s by the times of the file.
    assert source.rate_hz == pytest.approx(100 / 1.331)
    assert list(source.stamp_ns)[-1] == 1_331_000_000
    assert source.frames[0].max() == np.float32(2674.44)
    # The stated contact area, of sensels of 0.741 cm2.
    assert np.count_nonzero(source.frames[0]) == 92


class TestXsensor:
    def test_frames_of_the_first_sensor_whose_area_leaves_cells_never_pressed_masked(
        self, opened
    ):
        source = opened("sole.csv", xsensor_text())
        expected = [
            [[float(c) for c in row.split(",")] for row in rows]
            for rows in XSENSOR_FRAMES
        ]
        assert np.array_equal(source.frames, np.array(expected, dtype=np.float32))
        assert source.skin.unit == "mmHg"
        assert source.skin.f_max == 30
        assert source.skin.pitch_m == pytest.approx(0.0086)
        mask = source.skin.mask
        assert mask.tolist() == [
            [False, True, True, False],
            [True, True, True, False],
            [False, True, False, True],
        ]

    def test_empty_cells_are_masked_and_stay_so_and_zeros_beside_them_are_readings(
        self, opened
    ):
        assert opened("sole.csv", xsensor_text(area=12 * 0.86 * 0.86)).skin.mask is None
        with pytest.raises(SourceError, match="elsewhere than the first frame"):
            opened(
                "sole.csv",
                xsensor_text([[",1", "2,3"], ["1,1", "2,3"], [",1", "2,3"]], pad=""),
            )
        mask = opened(
            "sole.csv", xsensor_text([[",1,2", "0,0,"]] * 3, pad="")
        ).skin.mask
        assert mask.tolist() == [[False, True, True], [True, True, False]]

    def test_stamps_are_the_times_of_the_frames_over_midnight(self, opened):
        source = opened(
            "sole.csv",
            xsensor_text(times=("23:59:59.990", "00:00:00.000", "00:00:00.020")),
        )
        assert list(source.stamp_ns) == [0, 10_000_000, 30_000_000]
        assert source.rate_hz == pytest.approx(2 / 0.03)


TEXTS = {
    "foot.lst": emed_text(),
    "hand.asf": tekscan_text().rstrip("\n"),
    "hand.csv": tekscan_text(),
    "sole.csv": xsensor_text(),
}
#: Pieces that mean something in one of them.
PIECES = ["", "9", "-", "\t", ",", "\n", "\f", "\xb2", "nan", "SENSELS\n", "FRAME,"]


def found_in(folder, name, text):
    """A file with a text; None where it is refused, in one line."""
    path = folder / name
    path.write_bytes(text.encode("latin-1"))
    f_max = 100.0 if name in ("foot.lst", "sole.csv") else None
    found = []
    assert refusal(
        lambda: found.append(open_file(path, Layout(f_max=f_max)))
    ).isprintable()
    return found[0] if found else None


def test_the_number_of_taxels_shows_at_the_begin(tmp_path):
    for name, n in (("foot.lst", 12), ("hand.asf", 4)):
        (tmp_path / name).write_bytes(TEXTS[name].encode("latin-1"))
        assert n_taxels(str(tmp_path / name)) == n


@pytest.mark.parametrize("name", TEXTS)
def test_windows_line_ends_and_commas_of_a_spreadsheet_are_read_the_same(
    name, tmp_path
):
    whole = found_in(tmp_path, name, TEXTS[name])
    texts = [TEXTS[name].replace("\n", "\r\n")]
    if name == "hand.asf":
        texts.append(TEXTS[name].replace("\n", ",,,\n"))
    for text in texts:
        np.testing.assert_array_equal(
            found_in(tmp_path, name, text).frames, whole.frames
        )


@pytest.mark.parametrize("name", ["foot.lst", "hand.asf", "sole.csv"])
def test_a_file_cut_anywhere_is_refused_or_loses_whole_frames(name, tmp_path):
    text = TEXTS[name]
    whole = found_in(tmp_path, name, text)
    n_read = 0
    for end in range(1, len(text), 5):
        if (cut := found_in(tmp_path, name, text[:end])) is not None:
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
            st.sampled_from(PIECES)
            | st.binary(max_size=3).map(lambda b: b.decode("latin-1"))
        )
        text = text[:start] + new + text[start + data.draw(st.integers(0, 6)) :]
    source = found_in(tmp_path, name, text)
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
    shown = refusal(lambda: open_file(tmp_path / name), SourceError)
    assert re.search(f"{name}.*{message}", shown)
