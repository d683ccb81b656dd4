"""Figures of processes, read from /proc."""

from __future__ import annotations

import os
import resource
import subprocess
import sys

from sparseskin.nodes.process import proc


def test_figures_of_this_process_agree_with_the_system_calls() -> None:
    pid = os.getpid()
    before = resource.getrusage(resource.RUSAGE_SELF)
    used_s = proc.cpu_s(pid)
    after = resource.getrusage(resource.RUSAGE_SELF)
    tick_s = 1 / os.sysconf("SC_CLK_TCK")
    assert before.ru_utime + before.ru_stime - 2 * tick_s <= used_s
    assert used_s <= after.ru_utime + after.ru_stime + 2 * tick_s
    assert 0 < proc.resident_bytes(pid) <= 1024 * after.ru_maxrss * 1.01
    assert 0 < proc.own_bytes(pid) <= 1.5 * proc.resident_bytes(pid)
    with open(os.devnull) as _:
        assert proc.n_files(pid) >= 2
    assert proc.age_s(pid) > 0
    assert proc.host_busy_s() > 0


def test_a_child_is_found_with_its_state_and_command() -> None:
    wait = "import sys; print(flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", wait, "a word"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()
        assert proc.command(child.pid)[-1] == "a word"
        assert proc.state(child.pid) in "RSD"
