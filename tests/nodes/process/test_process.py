"""The process of a node: its CPUs, memory, loop, what it has counted, and what it is behind."""

import json
import os
import resource
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import wait_until
from damaged import refusal
from hypothesis import given
from hypothesis import strategies as st
from processes import wait_for_reader

from sparseskin.messages import End, PhiState, Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.network.sockets import Reader, Writer
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.node_host import NodeHost
from sparseskin.nodes.process import loop, proc, runner
from sparseskin.nodes.process.memory import EVERY, FreeMemory
from sparseskin.nodes.process.scheduling import MAX_CPU, MAX_PRIORITY, Scheduling
from sparseskin.nodes.process.tally import Tally
from sparseskin.nodes.settings import Settings

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
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


def test_keys_are_stated_one_by_one():
    stated = Scheduling.from_mapping({"cpus": [2, 0, 2], "priority": MAX_PRIORITY})
    assert stated == Scheduling((0, 2), MAX_PRIORITY)
    assert replace(stated, priority=0) == Scheduling((0, 2))


@pytest.mark.parametrize(
    ("key", "values", "fault"),
    [
        (
            "cpus",
            (0, [-1], [MAX_CPU + 1], [True], [0.0]),
            "expected a list of |.* outside 0..10",
        ),
        (
            "priority",
            (-1, MAX_PRIORITY + 1, True, 1.0),
            "expected a whole number|.* outside 0..98",
        ),
    ],
)
def test_what_is_no_list_of_cpus_and_no_priority_is_refused(key, values, fault):
    for value in values:
        with pytest.raises(SettingsError, match=rf"{key}: ({fault})"):
            Scheduling.from_mapping({key: value})


def test_a_cpu_that_the_process_may_not_use_is_refused(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 2})
    Scheduling((0, 2)).check_permitted()
    line = refusal(lambda: Scheduling((0, 1)).check_permitted(), SettingsError)
    assert line == "cpus: CPU 1 is not there for this process (allowed: 0, 2)"


def test_a_priority_without_the_privilege_is_refused(monkeypatch):
    before = os.sched_getscheduler(0)
    calls = []

    def refuse(pid, policy, parameters):
        calls.append(policy)
        if policy == os.SCHED_FIFO:
            raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    Scheduling().check_permitted()
    assert refusal(
        lambda: Scheduling(priority=10).check_permitted(), SettingsError
    ) == (
        "priority: 10 is not permitted to this user "
        "(allowed: 0; or a limit rtprio of 11 or more, as in limits.conf(5))"
    )
    assert calls == [os.SCHED_FIFO, before]  # the policy of the launcher is as before


def test_cpus_and_priority_are_those_of_the_process_and_of_threads_started_within():
    cpu = max(os.sched_getaffinity(0))
    assert applied((cpu,), 0) == [[[cpu], os.SCHED_OTHER]] * 3
    assert applied((), 0) == [[sorted(os.sched_getaffinity(0)), os.SCHED_OTHER]] * 3
    try:
        Scheduling(priority=1).check_permitted()
    except SettingsError as error:
        pytest.skip(str(error))
    policies = [policy for _, policy in applied((), 1)]
    assert policies == [os.SCHED_FIFO, os.SCHED_FIFO, os.SCHED_OTHER]


def test_memory_is_not_looked_through_while_no_file_can_be_opened():
    free, limits = FreeMemory(), resource.getrlimit(resource.RLIMIT_NOFILE)
    free.trim()
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, limits[1]))
    try:
        for _ in range(EVERY):
            free.trim()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_figures_of_this_process_agree_with_the_system_calls():
    pid = os.getpid()
    before = resource.getrusage(resource.RUSAGE_SELF)
    used_s = proc.cpu_s(pid)
    after = resource.getrusage(resource.RUSAGE_SELF)
    tick_s = 1 / os.sysconf("SC_CLK_TCK")
    assert before.ru_utime + before.ru_stime - 2 * tick_s <= used_s
    assert used_s <= after.ru_utime + after.ru_stime + 2 * tick_s
    assert 0 < proc.resident_bytes(pid) <= 1024 * after.ru_maxrss * 1.01
    assert proc.age_s(pid) > 0


@pytest.mark.parametrize(
    ("frame_ns", "n"),
    [(1_000, runner.BATCH), (runner.BATCH_NS // 4, 4), (2 * runner.BATCH_NS, 1)],
)
def test_slow_frames_keep_a_command_waiting_for_one_frame_at_most(
    frame_ns, n, monkeypatch
):
    now_ns = 0
    monkeypatch.setattr(runner.time, "monotonic_ns", lambda: now_ns)
    n_frames = 0
    for _ in runner._batch():
        n_frames += 1
        now_ns += frame_ns
    assert n_frames == n


@given(
    left_ns=st.integers(-(10**9), 10**11),
    sleep_ns=st.sampled_from([loop.SLEEP_NS, loop.SLEEP_ALONE_NS]),
)
def test_a_wait_for_a_tick_is_a_poll_that_waits_and_one_sleep_at_most(
    left_ns, sleep_ns
):
    n_polls = 0
    while (waiting_ms := loop.waiting_ms(left_ns, sleep_ns)) > 0:
        left_ns -= waiting_ms * 1_000_000
        n_polls += 1
        assert left_ns > 0
    assert n_polls <= 1
    assert left_ns < sleep_ns + 1_000_000


def test_what_a_killed_process_has_counted_is_there_to_the_last_message():
    tally = Tally(["/skin/taxels", "/skin/truth", "/skin/skin"])
    child = os.fork()
    if not child:
        own = Tally(["/skin/taxels", "/skin/truth", "/skin/skin"], tally.fd)
        for n in range(1, 1001):
            own.set("/skin/truth", n)
        own.set("/skin/skin", 1)
        own.set("/skin/other", 5)
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert tally.close() == {"/skin/truth": 1000, "/skin/skin": 1}


TAXELS, PHI = "/skin/taxels", "/skin/phi"


def taxels(seq):
    forces = np.ones((2, 2), np.float32)
    return Taxels(stamp_ns=seq, patch="skin", run_id="0" * 16, seq=seq, forces=forces)


class Tap(Node[Settings]):
    """Keeps the numbers of the frames that it is given."""

    def __init__(self):
        super().__init__(Settings(), Context("tap", ManualClock()))
        self.given = []
        self.overtaken_by_newer = []

    @classmethod
    def inputs(cls, settings):
        return (TAXELS,)

    def step(self, message):
        self.given.append(message.seq)
        return ()

    def overtaken(self, message):
        self.overtaken_by_newer.append(message.seq)


def test_what_is_skipped_on_a_socket_is_counted_and_an_end_ends(context):
    writer = Writer(context, "inproc://writer")
    reader = Reader(context, "reader", [writer.endpoint], [TAXELS, PHI])

    wait_for_reader(writer, "reader")
    for seq in (0, 1, 2, 4, 5, 6, 7):  # 3 is lost
        writer.send(taxels(seq))
    phi = PhiState(
        stamp_ns=0,
        patch="skin",
        kind="full",
        n=4,
        m=4,
        block=1,
        seed=0,
        fingerprint="0" * 16,
    )
    writer.send(phi)
    end = End(
        stamp_ns=9, patch="skin", run_id="0" * 16, seq=9, of="taxels", n_messages=9
    )
    writer.send(end)  # and so is 8
    node = Tap()
    host = NodeHost(node, "1" * 16, print)
    kept = []

    def ended():
        while (waiting := reader.take(3, [TAXELS.encode()])) is not None:
            kept.extend(host.receive_bytes(*waiting))
        return host.finished

    wait_until(ended, "the end of the stream")
    counts = host.counts.as_dict()
    # The end is none of the three that may wait: the last ones of a stream are all taken in.
    assert (node.given, node.overtaken_by_newer) == ([5, 6, 7], [0, 1, 2, 4])
    assert (counts["received"], counts["skipped"]) == ({TAXELS: 7}, {TAXELS: 4})
    assert counts["lost"] == {TAXELS: 2}
    # the state was not dropped on its way
    assert counts["refused"] == {"unknown topic": 1}
