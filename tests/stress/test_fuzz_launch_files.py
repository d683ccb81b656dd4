"""Mutated launch files: one line an error, exit code 2, and never a traceback.

At full size 20,000 files; `SPARSESKIN_FUZZ_FILES` states another number.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from stress import launch_files as fuzz_launch

N_FILES = int(os.environ.get("SPARSESKIN_FUZZ_FILES", "0"))


def test_every_fault_of_a_launch_file_is_a_line_that_names_it(full: bool, note: Any) -> None:
    n_files = N_FILES or (20_000 if full else 300)
    found = fuzz_launch.measure({"n": n_files, "seed": 7})
    note(files=n_files, **found)
    assert found["n_faulty"] == 0, found["faulty"]
    assert found["codes"].keys() == {"0", "2"}
    assert found["n_lines"] > found["codes"]["2"]


def test_faults_of_the_checker_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(fuzz_launch.NAME).write_text("nodes = 1")
    code, lines, fault = fuzz_launch.checked()
    assert (code, len(lines), fault) == (2, 1, "")

    def main(arguments: list[str]) -> int:
        raise ValueError("as if")

    monkeypatch.setattr(fuzz_launch, "main", main)
    fault = fuzz_launch.checked()[2]
    assert fault.startswith("raised ValueError: as if (")
    assert "test_fuzz_launch_files.py:" in fault
    monkeypatch.setattr(fuzz_launch, "main", lambda arguments: 2)
    assert fuzz_launch.checked()[2] == "exit code 2 with 0 lines"
    monkeypatch.setattr(fuzz_launch, "main", lambda arguments: 1)
    assert fuzz_launch.checked()[2] == "exit code 1"
