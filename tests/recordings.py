"""Recordings of real skins, for the tests that need them; they are not part of the repository."""

import os
from pathlib import Path

import pytest

FOLDER = Path(
    os.environ.get("SPARSESKIN_RECORDINGS")
    or Path(__file__).resolve().parents[2] / "shared" / "recordings"
)
"""SPARSESKIN_RECORDINGS, or else the folder ../shared/recordings beside the repository."""


def recording(name: str) -> Path:
    """Return the path of a recording, or skip the test."""
    path = FOLDER / name
    if not path.is_file():
        pytest.skip(f"{name} is not in the folder of recordings (SPARSESKIN_RECORDINGS)")
    return path
