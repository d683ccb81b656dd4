"""CPUs and priority of a node: what a launch file may state, and what a process then has."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import pytest

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.process.scheduling import MAX_CPU, MAX_PRIORITY, Scheduling

APPLIED = """
import json, os, threading
from sparseskin.nodes.process.scheduling import Scheduling

def scheduled():
    return [sorted(os.sched_getaffinity(0)), os.sched_getscheduler(0) & 7]

def in_thread():
    found = []
    thread = threading.Thread(target=lambda: found.extend(scheduled()))
    thread.start()
    thread.join()
    return found

with Scheduling({cpus}, {priority}).applied():
    within = in_thread()
print(json.dumps([scheduled(), within, in_thread()]))
"""


def applied(cpus, priority):
    """CPUs and policy of a process, of a thread started within and of one started after it."""
    code = APPLIED.format(cpus=cpus, priority=priority)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_keys_are_stated_one_by_one():
    stated = Scheduling.from_mapping({"cpus": [2, 0, 2], "priority": MAX_PRIORITY})
    assert stated == Scheduling((0, 2), MAX_PRIORITY)
    assert replace(stated, priority=0) == Scheduling((0, 2))


@pytest.mark.parametrize("value", [0, [-1], [MAX_CPU + 1], [True], [0.0]])
def test_what_is_no_list_of_cpus_is_refused(value):
    with pytest.raises(SettingsError, match=r"cpus: (expected a list of whole|.* outside 0..1023)"):
        Scheduling.from_mapping({"cpus": value})


@pytest.mark.parametrize("value", [-1, MAX_PRIORITY + 1, True, 1.0])
def test_what_is_no_priority_is_refused(value):
    with pytest.raises(
        SettingsError, match=r"priority: (expected a whole number|.* outside 0..98)"
    ):
        Scheduling.from_mapping({"priority": value})


def test_a_cpu_that_the_process_may_not_use_is_refused(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 2})
    Scheduling((0, 2)).check_permitted()
    with pytest.raises(SettingsError) as refused:
        Scheduling((0, 1)).check_permitted()
    assert str(refused.value) == "cpus: CPU 1 is not there for this process (allowed: 0, 2)"


def test_a_priority_without_the_privilege_is_refused(monkeypatch):
    before = os.sched_getscheduler(0)
    calls = []

    def refuse(pid, policy, parameters):
        calls.append(policy)
        if policy == os.SCHED_FIFO:
            raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    Scheduling().check_permitted()
    with pytest.raises(SettingsError) as refused:
        Scheduling(priority=10).check_permitted()
    assert str(refused.value) == (
        "priority: 10 is not permitted to this user "
        "(allowed: 0; or a limit rtprio of 11 or more, as in limits.conf(5))"
    )
    assert calls == [os.SCHED_FIFO, before]  # the policy of the launcher is as before


def test_a_process_and_all_its_threads_run_on_the_stated_cpus():
    cpu = max(os.sched_getaffinity(0))
    assert applied((cpu,), 0) == [[[cpu], os.SCHED_OTHER]] * 3
    assert applied((), 0) == [[sorted(os.sched_getaffinity(0)), os.SCHED_OTHER]] * 3


def test_the_priority_is_that_of_the_process_and_of_threads_started_within():
    try:
        Scheduling(priority=1).check_permitted()
    except SettingsError as error:
        pytest.skip(str(error))
    policies = [policy for _, policy in applied((), 1)]
    assert policies == [os.SCHED_FIFO, os.SCHED_FIFO, os.SCHED_OTHER]
