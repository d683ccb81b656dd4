"""Figures of processes, read from /proc."""

import os
import resource

from sparseskin.nodes.process import proc


def test_figures_of_this_process_agree_with_the_system_calls():
    pid = os.getpid()
    before = resource.getrusage(resource.RUSAGE_SELF)
    used_s = proc.cpu_s(pid)
    after = resource.getrusage(resource.RUSAGE_SELF)
    tick_s = 1 / os.sysconf("SC_CLK_TCK")
    assert before.ru_utime + before.ru_stime - 2 * tick_s <= used_s
    assert used_s <= after.ru_utime + after.ru_stime + 2 * tick_s
    assert 0 < proc.resident_bytes(pid) <= 1024 * after.ru_maxrss * 1.01
    assert 0 < proc.own_bytes(pid) <= 1.5 * proc.resident_bytes(pid)
    assert proc.age_s(pid) > 0
    assert proc.host_busy_s() > 0
