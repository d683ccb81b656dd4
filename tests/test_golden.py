"""Reconstructions do not change by accident: their bits where these can be compared, their PSNR."""

from __future__ import annotations

import json
import platform
from pathlib import Path

import golden
import pytest

EXPECTED = json.loads(Path(__file__).with_name("golden.json").read_text())
PSNR_TOLERANCE_DB = 0.05


def test_reconstructions_have_the_recorded_bits() -> None:
    if golden.versions() != EXPECTED["versions"]:
        pytest.skip(f"bits were recorded with {EXPECTED['versions']}")
    flags = Path("/proc/cpuinfo").read_text() if platform.machine() == "x86_64" else ""
    if "avx2" not in flags:
        pytest.skip("the kernel that the bits were recorded with needs AVX2")
    assert golden.golden()["hashes"] == EXPECTED["hashes"]


def test_psnr_of_every_scene_and_preset_is_the_recorded_one() -> None:
    psnr_db = golden.golden(kernel=None)["psnr_db"]
    assert psnr_db == pytest.approx(EXPECTED["psnr_db"], abs=PSNR_TOLERANCE_DB)
