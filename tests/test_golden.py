"""Reconstructions do not change by accident: their bits where these can be compared, their PSNR."""

import json
import platform
from pathlib import Path

import golden
import pytest

EXPECTED = json.loads(Path(__file__).with_name("golden.json").read_text())
PSNR_TOLERANCE_DB = 0.05


@pytest.mark.parametrize(
    "scenes",
    [
        ["path_40"],
        pytest.param(sorted({*golden.WINDOWS} - {"path_40"}), marks=pytest.mark.slow),
    ],
    ids=["path_40", "others"],
)
def test_reconstructions_have_the_recorded_bits_or_their_psnr(scenes):
    """Bits where versions and processor are those that they were recorded with, else the PSNR."""
    expected = {
        kind: {
            name: value
            for name, value in EXPECTED[kind].items()
            if name.split()[0] in scenes
        }
        for kind in ("hashes", "psnr_db")
    }
    flags = Path("/proc/cpuinfo").read_text() if platform.machine() == "x86_64" else ""
    if golden.versions() == EXPECTED["versions"] and "avx2" in flags:
        assert golden.golden(scenes)["hashes"] == expected["hashes"]
    else:
        psnr_db = golden.golden(scenes, kernel=None)["psnr_db"]
        assert psnr_db == pytest.approx(expected["psnr_db"], abs=PSNR_TOLERANCE_DB)
