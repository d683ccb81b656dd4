"""Tests that write modules of the same name do not get each other's."""

from __future__ import annotations

from pathlib import Path

import pytest

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import find_callable


@pytest.mark.parametrize("value", [1, 2])
def test_a_module_that_another_test_imported_is_imported_anew(
    value: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a_module_of_a_user.py").write_text(f"def value(): return {value}\n")
    monkeypatch.chdir(tmp_path)
    assert find_callable("a_module_of_a_user:value", SourceError)() == value
