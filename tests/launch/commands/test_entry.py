"""The entry point keeps bytecode where modules have none and may get none."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace

import pytest
from other_user import give

from sparseskin.launch.commands import entry


@pytest.fixture(autouse=True)
def no_bytecode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(sys, "pycache_prefix", None)
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    monkeypatch.setenv("PYTHONPYCACHEPREFIX", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def stored_at(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: SimpleNamespace(cached=str(path)))


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


@pytest.mark.parametrize("made", ["sparseskin", "sparseskin/bytecode"])
def test_code_is_loaded_from_no_folder_that_others_can_enter(
    made: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored_at(tmp_path / "none.pyc", monkeypatch)
    (tmp_path / made).mkdir(mode=0o700, parents=True)
    (tmp_path / made).chmod(0o755)
    entry.keep_bytecode()
    assert sys.pycache_prefix is None
    assert sys.dont_write_bytecode


@pytest.mark.parametrize("above", [False, True])
def test_code_is_loaded_from_no_folder_of_another_user(
    above: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored_at(tmp_path / "none.pyc", monkeypatch)
    for made in ("sparseskin", "sparseskin/bytecode"):
        (tmp_path / made).mkdir(mode=0o700)
    give(tmp_path / "sparseskin" if above else tmp_path / "sparseskin/bytecode")
    entry.keep_bytecode()
    assert sys.pycache_prefix is None


def test_no_bytecode_is_loaded_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored_at(tmp_path / "none.pyc", monkeypatch)
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / ".cache").mkdir()
    entry.keep_bytecode()
    assert sys.pycache_prefix == f"{tmp_path}/.cache/sparseskin/bytecode"


@pytest.mark.parametrize("module", ["argparse", "sparseskin.launch.commands.cli"])
def test_an_interrupt_of_the_imports_ends_with_130_and_no_traceback(
    module: str, tmp_path: Path
) -> None:
    # Importing the module interrupts, as Ctrl-C would at that moment.
    (tmp_path / "sitecustomize.py").write_text(
        textwrap.dedent(f"""
        import os, signal, sys

        # A background job of a shell would ignore it.
        signal.signal(signal.SIGINT, signal.default_int_handler)

        class Interrupting:
            def find_spec(self, name, path=None, target=None):
                if name == "{module}":
                    os.kill(os.getpid(), signal.SIGINT)

        sys.meta_path.insert(0, Interrupting())
        """)
    )
    done = subprocess.run(
        [sys.executable, "-m", "sparseskin", "--version"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_next_to_nothing_is_imported_before_an_interrupt_is_handled() -> None:
    code = (
        "import sys; before = set(sys.modules); import sparseskin.launch.commands.entry; "
        "print(*set(sys.modules) - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    own = ("sparseskin", "importlib._bootstrap")  # the latter has run before anything
    others = {name for name in done.stdout.split() if not name.startswith(own)}
    assert others <= {"__future__", "importlib", "warnings"}
