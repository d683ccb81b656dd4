"""Exports of pliance: what the parser reads, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from vendor_texts import ASC

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
