"""Exports of pliance: what the parser reads, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from vendor_texts import ASC

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.recorded import n_taxels, open_file


def test_a_pliance_export_is_put_on_the_grid_of_its_corners(tmp_path: Path) -> None:
    (tmp_path / "a.asc").write_text(ASC)
    source = open_file(tmp_path / "a.asc")
    # kPa times 1 cm2 is 0.1 N; the top row is the one of largest y.
    assert source.frames == pytest.approx(np.array([[[1, 0], [2, 0]], [[1.1, 0.5], [2, 0]]]))
    assert source.skin.mask is not None
    assert source.skin.mask.tolist() == [[True, True], [True, False]]
    assert (source.skin.unit, source.skin.pitch_m, source.rate_hz) == ("N", 0.01, 25.0)
    assert list(source.stamp_ns) == [0, 40_000_000]
    assert n_taxels(str(tmp_path / "a.asc")) == 3


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (
            "corner[cm]",
            "",
            "an insole (pedar) has them; allowed: an export whose sensors form a grid",
        ),
        ("x[c]   0.5   1.5   0.5", "x[c]   0.5   1.75  0.9", "form no grid by their x[c]"),
        ("x[c]   0.5   1.5   0.5", "x[c]   0.5   0.5   0.5", "two sensors at one place"),
        ("area   1.0   1.0   1.0", "area   1.0   1.0   2.0", "sensors of different size"),
        ("20.000\n   0.08", "-20.000\n   0.08", "is below 0; a range starts at 0"),
        ("11.000   5.000   20.000\n", "11.000   5.000\n", "holds 3 numbers, its header 4"),
        ("in kPa", "in psi", "pressures in 'psi'; allowed is kPa"),
        ("   0.08", "   0.04", "the times of the frames do not rise"),
        ("file name:", "name:", "not a pliance or pedar export"),
    ],
)
def test_another_asc_file_is_refused_with_its_place(
    tmp_path: Path, old: str, new: str, text: str
) -> None:
    (tmp_path / "a.asc").write_text(ASC.replace(old, new, 1))
    with pytest.raises(SourceError) as refused:
        open_file(tmp_path / "a.asc")
    assert text in str(refused.value)
