"""The entry point keeps bytecode where modules have none and may get none."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from sparseskin.launch.commands import entry


@pytest.fixture(autouse=True)
def no_bytecode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(sys, "pycache_prefix", None)
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    monkeypatch.setenv("PYTHONPYCACHEPREFIX", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def stored_at(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(entry, "find_spec", lambda _: SimpleNamespace(cached=str(path)))


def test_modules_without_bytecode_get_it_in_the_users_cache_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored_at(tmp_path / "none.pyc", monkeypatch)
    entry.keep_bytecode()
    assert sys.pycache_prefix == f"{tmp_path}/sparseskin/bytecode"
    assert not sys.dont_write_bytecode
    assert os.environ["PYTHONPYCACHEPREFIX"] == sys.pycache_prefix
    assert "PYTHONDONTWRITEBYTECODE" not in os.environ


def test_bytecode_that_is_there_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "module.pyc").touch()
    stored_at(tmp_path / "module.pyc", monkeypatch)
    entry.keep_bytecode()
    assert sys.pycache_prefix is None
    assert sys.dont_write_bytecode


def test_a_stated_folder_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "pycache_prefix", "/stated")
    entry.keep_bytecode()
    assert sys.pycache_prefix == "/stated"


def test_no_bytecode_is_loaded_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored_at(tmp_path / "none.pyc", monkeypatch)
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    entry.keep_bytecode()
    assert sys.pycache_prefix is None


def test_without_a_home_nothing_is_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored_at(tmp_path / "none.pyc", monkeypatch)
    monkeypatch.setenv("XDG_CACHE_HOME", "~/.cache")
    entry.keep_bytecode()
    assert sys.pycache_prefix is None
