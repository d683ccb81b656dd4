"""Recordings of vendors' formats: what the parsers read, and what they refuse."""

import numpy as np
import pytest
from recordings import recording
from vendor_texts import EMED_KPA, XSENSOR_FRAMES, emed_text, tekscan_text, xsensor_text

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.file_source import open_file


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
        return open_file(path, **stated)

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
        frame, columns, n_compared = -1, [], 0
        for line in path.read_bytes().decode("latin-1").split("\n"):
            cells = line.split("\t")
            if cells[-1] == "Force":
                frame += 1
                columns = [int(label) - 1 for label in cells[1:-1]]
            elif cells[0] == "Force":
                of_columns = frames[frame][:, columns].sum(axis=0)
                stated = [float(cell) for cell in cells[1:-1]]
                np.testing.assert_allclose(of_columns, stated, rtol=0, atol=0.0051)
                assert frames[frame].sum() == pytest.approx(float(cells[-1]), abs=0.0051)
            elif cells[0].isdigit():
                row = int(cells[0]) - 1
                assert frames[frame][row].sum() == pytest.approx(float(cells[-1]), abs=0.0051)
                n_compared += 1
        assert (frame, n_compared) == (105, 106 * 54)


class TestRealTekscan:
    def test_size_rate_range_unit_pitch_mask_and_stamps(self):
        source = open_file(recording("iscan_test.csv"))
        frames, stamps, mask = frames_of(source), stamps_of(source), source.skin.mask
        assert frames.shape == (309, 28, 28)
        assert source.rate_hz == pytest.approx(10.0)
        assert source.skin.unit == "raw"
        assert (frames.min(), frames.max(), source.skin.f_max) == (0, 100, 100.0)
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
        whole, example = open_file(recording("iscan_test.csv")), open_file("example:fingers")
        np.testing.assert_array_equal(example.frames, whole.frames)
        assert (example.stamp_ns, example.skin.unit) == (whole.stamp_ns, whole.skin.unit)


class TestEmed:
    def test_touched_cells_land_on_the_full_matrix_in_newtons(self, opened):
        source = opened("foot.lst", emed_text())
        frames = frames_of(source)
        assert frames.shape == (2, 4, 3)
        np.testing.assert_allclose(frames[:, 1:, 1:], 0.025 * np.array(EMED_KPA))
        assert not frames[:, 0].any()
        assert not frames[:, :, 0].any()
        assert source.skin.f_max == pytest.approx(2.5)  # the page of peaks is no frame
        assert (source.skin.unit, source.rate_hz) == ("N", 100.0)
        assert stamps_of(source) == [0, 10_000_000]

    def test_oblong_sensors_have_no_pitch_and_an_area_any_square(self, opened):
        text = emed_text().replace("0.500x0.500", "0.500x0.400").replace("cm\xb2", "cm\xc2\xb2")
        skin = opened("foot.lst", text).skin
        assert (skin.pitch_m, skin.f_max) == (None, pytest.approx(2.5))


class TestTekscan:
    def test_cells_marked_b_are_masked_and_not_readings(self, opened):
        source = opened("HAND.ASF", tekscan_text())
        np.testing.assert_array_equal(source.skin.mask, [[False, True, True], [True, True, False]])
        np.testing.assert_array_equal(
            frames_of(source),
            [[[0, 1, 2], [0, 3, 0]], [[0, 0, 5], [7, 0, 0]], [[0, 0, 0], [0, 9, 0]]],
        )
        assert (source.skin.f_max, source.skin.unit, source.rate_hz) == (9.0, "raw", 10.0)
        assert stamps_of(source) == [0, 100_000_000, 210_000_000]

    def test_times_that_do_not_tell_frames_apart_give_way_to_the_period(self, opened):
        source = opened("hand.csv", tekscan_text(times=("0", "0.01", "0.01")))
        assert stamps_of(source) == [0, 100_000_000, 200_000_000]

    @pytest.mark.parametrize(
        ("rows", "cols", "pitch_m"),
        [("0.05 inches", "0.127 CM", 0.00127), ("2.5 mm", "1.25 mm", None)],
    )
    def test_the_pitch_is_the_spacing_where_rows_and_columns_agree(
        self, opened, rows, cols, pitch_m
    ):
        text = tekscan_text().replace("ROW_SPACING 0.127 centimeters", f"ROW_SPACING {rows}")
        text = text.replace("COL_SPACING 0.127 centimeters", f"COL_SPACING {cols}")
        found = opened("hand.csv", text).skin.pitch_m
        assert found == (None if pitch_m is None else pytest.approx(pitch_m))

    def test_calibrated_units_are_kept_and_their_raw_sum_is_not_compared(self, opened):
        text = tekscan_text(unit="kPa").replace("B,0,5", "B,0,5.5")
        source = opened("hand.csv", text)
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
    def test_frames_of_the_first_sensor_whose_area_leaves_cells_never_pressed_masked(self, opened):
        source = opened("sole.csv", xsensor_text())
        expected = [
            [[float(cell) for cell in row.split(",")] for row in rows] for rows in XSENSOR_FRAMES
        ]
        assert np.array_equal(source.frames, np.array(expected, dtype=np.float32))
        assert (source.skin.unit, source.skin.f_max) == ("mmHg", 30)
        assert source.skin.pitch_m == pytest.approx(0.0086)
        mask = source.skin.mask
        assert mask.tolist() == [
            [False, True, True, False],
            [True, True, True, False],
            [False, True, False, True],
        ]

    def test_a_mat_whose_area_is_its_grid_has_no_mask(self, opened):
        assert opened("sole.csv", xsensor_text(area=12 * 0.86 * 0.86)).skin.mask is None

    def test_empty_cells_are_masked_and_zeros_beside_them_are_readings(self, opened):
        mask = opened("sole.csv", xsensor_text([[",1,2", "0,0,"]] * 3, pad="")).skin.mask
        assert mask.tolist() == [[False, True, True], [True, True, False]]

    def test_stamps_are_the_times_of_the_frames_over_midnight(self, opened):
        source = opened(
            "sole.csv", xsensor_text(times=("23:59:59.990", "00:00:00.000", "00:00:00.020"))
        )
        assert list(source.stamp_ns) == [0, 10_000_000, 30_000_000]
        assert source.rate_hz == pytest.approx(2 / 0.03)

    def test_a_mask_that_changes_is_refused(self, opened):
        with pytest.raises(SourceError, match="elsewhere than the first frame"):
            opened("sole.csv", xsensor_text([[",1", "2,3"], ["1,1", "2,3"], [",1", "2,3"]], pad=""))
