"""Exports of XSENSOR: what is read of them, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import recording
from vendor_texts import XSENSOR_FRAMES, xsensor_text

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.file_source import RecordedSource, open_file

Opener = Callable[..., RecordedSource]


@pytest.fixture
def opened(tmp_path: Path) -> Opener:
    """Write a text to a file and open it."""

    def write_and_open(text: str, **stated: Any) -> RecordedSource:
        path = tmp_path / "foot.csv"
        path.write_bytes(text.encode("latin-1"))
        return open_file(path, **stated)

    return write_and_open


def test_a_recording_of_an_insole_has_the_left_foot_of_the_file() -> None:
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
        self, opened: Opener
    ) -> None:
        source = opened(xsensor_text())
        expected = [
            [[float(cell) for cell in row.split(",")] for row in rows] for rows in XSENSOR_FRAMES
        ]
        assert np.array_equal(source.frames, np.array(expected, dtype=np.float32))
        assert (source.skin.unit, source.skin.f_max) == ("mmHg", 30)
        assert source.skin.pitch_m == pytest.approx(0.0086)
        mask = source.skin.mask
        assert mask is not None
        assert mask.tolist() == [
            [False, True, True, False],
            [True, True, True, False],
            [False, True, False, True],
        ]

    def test_a_mat_whose_area_is_its_grid_has_no_mask(self, opened: Opener) -> None:
        assert opened(xsensor_text(area=12 * 0.86 * 0.86)).skin.mask is None

    def test_empty_cells_are_masked_and_zeros_beside_them_are_readings(
        self, opened: Opener
    ) -> None:
        mask = opened(xsensor_text([[",1,2", "0,0,"]] * 3, pad="")).skin.mask
        assert mask is not None
        assert mask.tolist() == [[False, True, True], [True, True, False]]

    def test_stamps_are_the_times_of_the_frames_over_midnight(self, opened: Opener) -> None:
        source = opened(xsensor_text(times=("23:59:59.990", "00:00:00.000", "00:00:00.020")))
        assert list(source.stamp_ns) == [0, 10_000_000, 30_000_000]
        assert source.rate_hz == pytest.approx(2 / 0.03)

    def test_repeated_times_are_no_stamps(self, opened: Opener) -> None:
        source = opened(xsensor_text(times=("08:00:00",) * 3))
        assert source.rate_hz is None
        assert list(source.stamp_ns) == [0, 10_000_000, 20_000_000]

    def test_a_mask_that_changes_is_refused(self, opened: Opener) -> None:
        with pytest.raises(SourceError, match="elsewhere than the first frame"):
            opened(xsensor_text([[",1", "2,3"], ["1,1", "2,3"], [",1", "2,3"]], pad=""))

    def test_an_export_without_frames_is_refused(self, opened: Opener) -> None:
        with pytest.raises(SourceError, match="holds no line FRAME"):
            opened('File:,"a.XSN"\nUnits:,mmHg\n')
