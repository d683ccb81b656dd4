"""Reconstructions do not change by accident: their bits where these can be compared, their PSNR."""

from __future__ import annotations

import json
import platform
from pathlib import Path

import golden
import pytest

EXPECTED = json.loads(Path(__file__).with_name("golden.json").read_text())
PSNR_TOLERANCE_DB = 0.05


def test_reconstructions_have_the_recorded_bits_or_their_psnr() -> None:
    """Bits where versions and processor are those that they were recorded with, else the PSNR."""
    flags = Path("/proc/cpuinfo").read_text() if platform.machine() == "x86_64" else ""
    if golden.versions() == EXPECTED["versions"] and "avx2" in flags:
        assert golden.golden()["hashes"] == EXPECTED["hashes"]
    else:
        psnr_db = golden.golden(kernel=None)["psnr_db"]
        assert psnr_db == pytest.approx(EXPECTED["psnr_db"], abs=PSNR_TOLERANCE_DB)
