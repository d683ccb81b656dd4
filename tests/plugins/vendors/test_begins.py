"""Begins of vendors' files: what shows before a recording is read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.recorded import n_taxels

MASK = np.ones((6, 8), np.bool_)
MASK[:, 0] = MASK[0, 1] = MASK[0, 2] = False


def test_the_number_of_taxels_shows_at_the_begin(tmp_path: Path) -> None:
    frame = "\n".join(",".join(row) for row in np.where(MASK, "1", "B"))
    header = "DATA_TYPE MOVIE\nROWS 6\nCOLS 8\nUNITS N\nASCII_DATA @@\n"
    (tmp_path / "movie.asf").write_text(f"{header}Frame 1\n{frame}\n@@\n")
    page = "Matrix: 8x6\nSensor area: 0.25 cm2\nTime/picture: 20 ms\nSensor size: 0.5x0.5 cm\n"
    (tmp_path / "emed.lst").write_text(f"{page}Pict-No.: 1\n\t1\n1\t10.0\n\f")
    assert n_taxels(str(tmp_path / "movie.asf")) == 40
    assert n_taxels(str(tmp_path / "emed.lst")) == 48
    (tmp_path / "text.lst").write_text("no export")
    with pytest.raises(SourceError, match="not an emed text export"):
        n_taxels(str(tmp_path / "text.lst"))
