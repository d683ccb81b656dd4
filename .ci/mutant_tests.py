"""Tests of a copy of the repository, each run in a process forked from this one."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hypothesis
import msgpack  # noqa: F401 (imported once, for all tests)
import numpy  # noqa: F401
import pytest
import pywt  # noqa: F401
import scipy.signal  # noqa: F401
import zmq  # noqa: F401

#: What is imported as `mutant_reach` by the marked modules, in every process of a test.
REACH = """\
import contextlib, os, time

path = os.environ.get("MUTANT_REACH", "")
seen = set()
_until = 0.0


def reach(mark):
    global _until
    now = time.monotonic()
    if now > _until:  # a process that lasts for several tests notes its statements for each
        seen.clear()
        _until = now + 0.2
    if path and mark not in seen:
        seen.add(mark)
        with contextlib.suppress(OSError):
            file = os.open(path, os.O_WRONLY | os.O_APPEND)
            os.write(file, mark.encode() + b"\\n")
            os.close(file)
"""
WAIT_S = 0.02
"""Time between two looks at the tests that run, seconds."""
_ALL_FILES = ""


@dataclass(frozen=True)
class Test:
    """One test, and what it runs."""

    name: str
    seconds: float
    marks: frozenset[str]
    """`module:line` of the statements that it reaches, in all of its processes."""


class _Recorder:
    """Plug-in of pytest: notes what each test reaches, and writes it to a file at the end."""

    def __init__(self, marks: Path, result: Path) -> None:
        self._marks = marks
        self._result = result
        self._shared: dict[str, set[str]] = {}
        self._seconds: dict[str, float] = {}
        self._reached: dict[str, set[str]] = {}

    def pytest_collection_finish(self) -> None:
        self._shared[_ALL_FILES] = self._take()

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._reached[nodeid] = set()
        self._seconds[nodeid] = 0.0
        self._take()

    @pytest.hookimpl(trylast=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._seconds[report.nodeid] += report.duration
        marks = self._take()
        self._reached[report.nodeid] |= marks
        if report.when == "setup":
            # A fixture of the whole file may have been made: the other tests use it, too.
            self._shared.setdefault(report.nodeid.partition("::")[0], set()).update(
                marks
            )
        if report.failed:
            print(report.longreprtext, file=sys.stderr)

    def pytest_sessionfinish(self) -> None:
        tests = [
            [name, self._seconds[name], sorted(marks | self._shared_by(name))]
            for name, marks in self._reached.items()
        ]
        self._result.write_text(json.dumps(tests))

    def _shared_by(self, name: str) -> set[str]:
        return self._shared[_ALL_FILES] | self._shared.get(
            name.partition("::")[0], set()
        )

    def _take(self) -> set[str]:
        marks = set(self._marks.read_text().split())
        self._marks.write_text("")
        recorder = sys.modules.get("mutant_reach")
        if recorder is not None:
            recorder.seen.clear()
        return marks


class _FirstFailure:
    """Plug-in of pytest: writes the name of the first test that fails."""

    def __init__(self, result: Path) -> None:
        self._result = result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._result.write_text(report.nodeid)


class _Quick:
    """Plug-in of pytest: no compilation in the background, and examples are not made smaller."""

    def pytest_configure(self, config: Any) -> None:
        config.workerinput = {}  # conftest.py compiles loops in the main process of a run alone
        phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
        profile = hypothesis.settings.get_profile("busy host")
        hypothesis.settings.register_profile(
            "mutants", profile, phases=phases, database=None
        )
        hypothesis.settings.load_profile("mutants")


def record(tree: Path, paths: Sequence[str]) -> list[Test]:
    """Run the quick tests of some paths in a tree of marked modules."""
    marks = tree / "reached.txt"
    marks.write_text("")
    result = tree / "reached.json"
    (tree / "src" / "mutant_reach.py").write_text(REACH)
    code = _run(
        tree, [*paths, "-m", "not slow"], [_Recorder(marks, result)], 3600.0, marks
    )
    if code or not result.is_file():
        print((tree / "output.txt").read_text()[-3000:], file=sys.stderr)
        raise SystemExit("the tests fail without a mutant")
    return [
        Test(name, s, frozenset(reached))
        for name, s, reached in json.loads(result.read_text())
    ]


def first_failure(tree: Path, tests: Sequence[Test]) -> str:
    """Name of the first test that fails in the tree, "time" or "import"; "" if all pass."""
    result = tree / "failed.txt"
    result.unlink(missing_ok=True)
    limit_s = 20.0 + 5.0 * sum(test.seconds for test in tests)
    code = _run(
        tree, ["-x", *(test.name for test in tests)], [_FirstFailure(result)], limit_s
    )
    if not code:
        return ""
    if result.is_file():
        return result.read_text()
    return "time" if code < 0 else "import"


def _run(
    tree: Path,
    arguments: list[str],
    plugins: list[Any],
    limit_s: float,
    marks: Path | None = None,
) -> int:
    """Exit code of pytest in the tree; negative if it was killed, after `limit_s` at the latest."""
    mark = f"MUTANT_RUN={os.getpid()}.{time.monotonic_ns()}"
    pid = os.fork()
    if not pid:
        _become_pytest(tree, arguments, [*plugins, _Quick()], mark, marks)
    # Waits are counted, and not read from a clock: it goes on where all processes are stopped.
    waited_s = 0.0
    status = None
    while status is None:
        if waited_s > limit_s:
            os.kill(pid, signal.SIGKILL)
        done, found = os.waitpid(pid, os.WNOHANG)
        if done:
            status = os.waitstatus_to_exitcode(found)
        else:
            time.sleep(WAIT_S)
            waited_s += WAIT_S
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    _kill_marked(mark)
    return status


def _become_pytest(
    tree: Path, arguments: list[str], plugins: list[Any], mark: str, marks: Path | None
) -> None:
    output = os.open(tree / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.setsid()
    os.chdir(tree)
    source = str(tree / "src")
    sys.path.insert(0, source)
    name, _, value = mark.partition("=")
    os.environ |= {name: value, "PYTHONPATH": source}
    if marks is not None:
        os.environ["MUTANT_REACH"] = str(marks)
    options = ["-q", "-p", "no:xdist", "-p", "no:cacheprovider", "--hypothesis-seed=0"]
    code = 1
    try:
        code = int(pytest.main([*options, *arguments], plugins=plugins))
    finally:
        sys.stdout.flush()
        os._exit(code)


def _kill_marked(mark: str) -> None:
    """Kill the processes that a run of tests has left."""
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            with contextlib.suppress(OSError):
                if mark.encode() in (folder / "environ").read_bytes().split(b"\0"):
                    os.kill(int(folder.name), signal.SIGKILL)
