"""A command that gives way: what the scheduler is told of it, and what a terminal sees of it."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import wait_until

from sparseskin.launch.attach import give_way as module
from sparseskin.nodes.process import proc

BEGIN = "import os, signal, sys; from sparseskin.launch.attach.give_way import give_way; "
WAIT = "give_way(); print(os.getpid(), flush=True); signal.pause()"
weighs_sessions = pytest.mark.skipif(
    not module._sessions_are_weighed(), reason="this system does not weigh sessions"
)


@pytest.fixture
def begin():
    """Run some lines of Python in a process of their own."""
    processes = []

    def run(lines):
        command = [sys.executable, "-c", BEGIN + lines]
        # In a group of its own, which is not orphaned: SIGTSTP would do nothing there.
        processes.append(
            subprocess.Popen(command, stdout=subprocess.PIPE, text=True, process_group=0)
        )
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        process.communicate()


def worker_of(process):
    """The process that does the work: it printed its number."""
    return int(process.stdout.readline())


@weighs_sessions
def test_its_work_has_a_session_of_its_own_that_alone_gives_way_and_ends_with_it(begin):
    before = Path("/proc/self/autogroup").read_text()
    process = begin(WAIT)
    worker = worker_of(process)
    assert os.getsid(worker) == worker
    assert Path(f"/proc/{worker}/autogroup").read_text().endswith(f" nice {module.NICE}\n")
    assert Path("/proc/self/autogroup").read_text() == before
    process.kill()
    process.wait()
    wait_until(lambda: not Path(f"/proc/{worker}").exists() or proc.state(worker) == "Z", "its end")


def test_where_sessions_are_not_weighed_the_process_itself_gives_way(monkeypatch, tmp_path):
    nices = []
    monkeypatch.setattr("os.nice", nices.append)
    monkeypatch.setattr(module, "AUTOGROUP_ENABLED", tmp_path / "none")
    pid = os.getpid()
    module.give_way()
    assert os.getpid() == pid
    assert nices == [module.NICE]


@weighs_sessions
def test_it_ends_with_the_code_of_a_signal_that_ended_its_work(begin):
    process = begin(WAIT)
    os.kill(worker_of(process), signal.SIGKILL)
    assert process.wait() == 128 + signal.SIGKILL


def test_signals_reach_what_does_the_work(begin):
    process = begin("signal.signal(signal.SIGHUP, lambda *_: sys.exit(7)); " + WAIT)
    both = {process.pid, worker_of(process)}
    process.send_signal(signal.SIGTSTP)
    wait_until(lambda: {proc.state(pid) for pid in both} == {"T"}, "both to stop")
    process.send_signal(signal.SIGCONT)
    wait_until(lambda: {proc.state(pid) for pid in both} == {"S"}, "both to go on")
    process.send_signal(signal.SIGHUP)
    assert process.wait() == 7
