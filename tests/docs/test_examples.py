"""Every file in examples/ runs as it stands."""

import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
#: Drivers of hardware: test_drivers.py runs them against simulated skins.
DRIVERS = {"serial_skin", "udp_skin", "wuji_glove"}
#: Run below, as a job of several processes.
JOBS = {"mpi_pool", "dask_pool"}
WITH_PICTURE = {"first_contact", "your_own_skin", "choosing_m", "calibrate"}
SLOW = WITH_PICTURE | {"run_graph", "own_solver", "noise_around_zero", "mujoco_skin"}
ARGUMENTS = {"board_emulator": ["--frames", "3"]}
#: What each prints on its page (make gallery).
PRINTED = tomllib.loads((EXAMPLES.parent / "docs/reference/examples.toml").read_text())
#: Packages of extras that examples need.
NEEDS = {"mujoco_skin": "mujoco"}


def names():
    found = sorted(path.stem for path in EXAMPLES.glob("*.py") if path.stem not in DRIVERS | JOBS)
    return [pytest.param(name, marks=pytest.mark.slow if name in SLOW else []) for name in found]


def run(name, folder, monkeypatch, *arguments):
    """Run an example as a program, in an empty folder."""
    path = EXAMPLES / f"{name}.py"
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setattr(sys, "argv", [str(path), *arguments])
    runpy.run_path(str(path), run_name="__main__")


@pytest.mark.parametrize("name", names())
def test_an_example_runs_and_prints_its_result(name, tmp_path, monkeypatch, capsys):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], reason=f"{NEEDS[name]} is not installed")
    arguments = ["out.png"] if name in WITH_PICTURE else ARGUMENTS.get(name, [])
    run(name, tmp_path, monkeypatch, *arguments)
    printed = capsys.readouterr().out
    # Its page is of this example: the last lines differ in numbers at most.
    last = {re.sub(r"[-\d.]+", "#", text.splitlines()[-1]) for text in (printed, PRINTED[name])}
    assert len(last) == 1
    if name in WITH_PICTURE:
        assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")


def test_each_example_begins_with_a_line_on_what_it_shows():
    for path in EXAMPLES.glob("*.py"):
        first = path.read_text(encoding="utf-8").splitlines()[0]
        assert re.fullmatch(r'"""[A-Z].*[.:]', first), path.name


@pytest.mark.slow
def test_tasks_are_shared_by_the_processes_of_an_mpi_job(tmp_path):
    pytest.importorskip("mpi4py")
    mpiexec = shutil.which("mpiexec", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if mpiexec is None or subprocess.run([sys.executable, "-c", "import mpi4py.MPI"]).returncode:
        pytest.skip("needs an MPI library and its mpiexec")
    job = [mpiexec, "-n", "3", sys.executable, "-m", "mpi4py.futures"]
    shutil.copy(EXAMPLES / "mpi_pool.py", tmp_path)
    done = subprocess.run([*job, "mpi_pool.py"], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.startswith("8 tasks on processes [1"), done.stderr
    assert "0" not in done.stdout.partition("[")[2].partition("]")[0]
