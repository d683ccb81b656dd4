"""Another user of the host, for tests that root runs."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

NOBODY = 65534
Run = Callable[[str], str]


def become_nobody() -> Run:
    """What runs Python code as another user and returns its last line; skips where impossible."""
    if os.geteuid() != 0:
        pytest.skip("only root can act as another user")
    if shutil.which("setpriv") is None:
        pytest.skip("setpriv (util-linux) is not installed")
    become = ("setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups")

    def run(python: str, code: str) -> subprocess.CompletedProcess[str]:
        command = [*become, python, "-I", "-c", code]
        return subprocess.run(
            command, capture_output=True, text=True, check=False, cwd="/"
        )

    def last_line(python: str, code: str) -> str:
        done = run(python, code)
        error = done.stderr.strip().split("\n")[-1].split(":")[0]
        return error or done.stdout.strip().split("\n")[-1]

    for python in (sys.executable, "/usr/bin/python3", "/usr/local/bin/python3"):
        if run(python, "pass").returncode == 0:
            return lambda code: last_line(python, code)
    pytest.skip("the other user can start no Python")


def give(path: Path, *, link: bool = False) -> None:
    """Give a file or folder to the other user; the test is skipped where that is impossible."""
    try:
        os.chown(path, NOBODY, NOBODY, follow_symlinks=not link)
    except PermissionError:
        pytest.skip("only root can give a file to another user")
