"""The points of a study: kept as they are computed, and never computed twice."""

import json
import os
import signal
import subprocess
import sys
from collections import Counter

import pytest
from conftest import PATIENCE_S, wait_until
from processes import processes_with

from sparseskin.studies import points as points_module
from sparseskin.studies.points import POINTS_FILE, StudyError, compute, forget

#: A study of eight points, of which the last four wait for a file. It notes each computation.
STUDY = """
import sys, time
from pathlib import Path

from sparseskin.launch.commands.entry import main
from sparseskin.studies import command
from sparseskin.studies.points import compute


def square(point):
    with open("calls", "a") as file:
        file.write(f"{point['k']}\\n")
    while point["k"] >= 4 and not Path("go").exists():
        time.sleep(0.01)
    return {"square": point["k"] ** 2}


def run(out, quick, seed, executor):
    figures = compute(square, [{"k": k} for k in range(8)], out, executor, "squares")
    (out / "squares.md").write_text(str([f["square"] for f in figures]))


if __name__ == "__main__":
    command.STUDIES["squares"] = command.Study("squares", target="__main__:run")
    sys.exit(main())
"""


class Run:
    """A process that runs the study; its workers carry its mark."""

    def __init__(self, folder, executor):
        self._mark = f"SPARSESKIN_TEST_STUDY={folder}"
        (folder / "a_study.py").write_text(STUDY)
        # What a shell runs in the background ignores Ctrl-C, and so would what it starts.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        self.process = subprocess.Popen(
            [sys.executable, "a_study.py", "study", "squares", "--executor", executor],
            cwd=folder,
            env={**os.environ, "SPARSESKIN_TEST_STUDY": str(folder)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        signal.signal(signal.SIGINT, before)

    def finish(self):
        """Exit code and stderr."""
        _, stderr = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, stderr

    def survivors(self):
        """Processes that carry the mark."""
        return processes_with(self._mark)


def n_lines(path):
    return len(path.read_bytes().splitlines()) if path.exists() else 0


def calls(folder):
    return Counter(map(int, (folder / "calls").read_text().split()))


@pytest.mark.slow
def test_a_run_that_is_killed_goes_on_where_it_was(tmp_path):
    points = tmp_path / "out" / "squares" / POINTS_FILE
    first = Run(tmp_path, "process:2")
    wait_until(lambda: n_lines(points) == 4, "four points")
    first.process.send_signal(signal.SIGKILL)
    first.finish()
    wait_until(lambda: not first.survivors(), "the workers to end")
    n_under_way = sum(calls(tmp_path).values()) - 4
    with points.open("ab") as file:
        file.write(b'{"key": "torn by the e')
    (tmp_path / "go").touch()

    code, stderr = Run(tmp_path, "process:2").finish()
    assert code == 0, stderr
    assert "4 of 8 points are known" in stderr
    assert (tmp_path / "out/squares/squares.md").read_text() == str(
        [k**2 for k in range(8)]
    )
    assert n_under_way <= 2
    assert sum(calls(tmp_path).values()) == 8 + n_under_way
    assert all(calls(tmp_path)[k] == 1 for k in range(4))
    assert len([json.loads(line) for line in points.read_text().splitlines()]) == 8


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("executor", ["process:2", "serial"])
def test_a_signal_ends_it_without_a_traceback_and_without_workers(
    tmp_path, number, executor
):
    points = tmp_path / "out" / "squares" / POINTS_FILE
    run = Run(tmp_path, executor)
    wait_until(lambda: n_lines(points) == 4, "four points")
    os.killpg(run.process.pid, number)
    code, stderr = run.finish()
    assert code == 128 + number
    assert "Traceback" not in stderr
    assert "leaked" not in stderr
    wait_until(lambda: not run.survivors(), "the workers to end")
    assert n_lines(points) == 4


def double(point):
    return {"double": 2 * point["k"], "pair": (point["k"], 1.5)}


def fail_on_two(point):
    if point["k"] == 2:
        raise ValueError("two is\nnot allowed")
    return double(point)


def test_figures_are_in_the_order_of_the_points_and_the_same_when_read(tmp_path):
    points = [{"k": k} for k in (3, 1, 3, 2)]
    fresh = compute(double, points, tmp_path, "thread:3", "doubles")
    assert [figures["double"] for figures in fresh] == [6, 2, 6, 4]
    assert n_lines(tmp_path / POINTS_FILE) == 3
    assert compute(double, points, tmp_path, "thread:3", "doubles") == fresh
    assert n_lines(tmp_path / POINTS_FILE) == 3


def test_points_of_earlier_runs_are_reported_until_forgotten(
    tmp_path, monkeypatch, capsys
):
    compute(double, [{"k": 1}], tmp_path, "serial", "doubles")
    compute(double, [{"k": 1}, {"k": 2}], tmp_path, "serial", "doubles")
    assert (
        "1 of 2 points are known from an earlier run (--anew" in capsys.readouterr().err
    )
    monkeypatch.setattr(points_module, "code_fingerprint", lambda: "another")
    compute(double, [{"k": 1}, {"k": 2}, {"k": 3}], tmp_path, "serial", "doubles")
    assert (
        "2 of 3 points are known from an earlier run, 2 of them by"
        in capsys.readouterr().err
    )
    forget(tmp_path)
    assert n_lines(tmp_path / POINTS_FILE) == 0
    compute(double, [{"k": 1}], tmp_path, "serial", "doubles")
    assert "known from an earlier run" not in capsys.readouterr().err


def test_a_point_that_fails_is_named_and_a_second_run_in_the_same_folder_refused(
    tmp_path,
):
    with pytest.raises(
        StudyError, match=r"point k = 2: ValueError: two is not allowed"
    ):
        compute(fail_on_two, [{"k": k} for k in range(3)], tmp_path, "serial", "some")
    assert n_lines(tmp_path / POINTS_FILE) == 2

    def compute_again(point):
        with pytest.raises(StudyError, match="another run of a study uses it"):
            compute(double, [{"k": 0}], tmp_path, "serial", "doubles")
        return {}

    assert compute(compute_again, [{"k": 0}], tmp_path, "serial", "outer") == [{}]
