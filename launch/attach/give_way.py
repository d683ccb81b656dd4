"""Lowest scheduling weight for a command that observes a running graph.

Niceness alone does not do it. A scheduler that groups processes by session (Linux: autogroup, see
sched(7)) weighs whole sessions against each other, and a process's niceness against those of its
own session only. Each node has a session of its own; a command has to have one too, and with it
the niceness of a session.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from pathlib import Path
from typing import NoReturn

NICE = 19
"""The most there is. At 10, the median latency of a graph on two busy cores still grew by half."""
AUTOGROUP = Path("/proc/self/autogroup")
AUTOGROUP_ENABLED = Path("/proc/sys/kernel/sched_autogroup_enabled")
TRIES, TRY_S = 20, 0.05
"""The system takes ten changes of autogroups a second, no more."""
PR_SET_PDEATHSIG = 1
PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP)


def give_way() -> None:
    """Let this command run only where the graph leaves it room.

    Where sessions are weighed, the command continues in a child with a session of its own. This
    process remains the one that the terminal knows: it passes signals on, and ends as the child
    does. To be called before there are threads.
    """
    import ctypes  # a completion of `topic` needs none

    with contextlib.suppress(OSError):
        os.nice(NICE)
    if not _sessions_are_weighed():
        return
    sys.stdout.flush()
    # A signal that comes before its handler is there would not reach the child.
    unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, PASSED_ON)
    if child := os.fork():
        _stand_for(child, unblocked)
    signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    os.setsid()
    for _ in range(TRIES):
        try:
            AUTOGROUP.write_text(str(NICE))
            break
        except BlockingIOError:
            time.sleep(TRY_S)
        except OSError:
            break
    # A processor that runs nothing else now counts as one that a waking node may take.
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def _sessions_are_weighed() -> bool:
    try:
        return AUTOGROUP_ENABLED.read_text().strip() == "1" and AUTOGROUP.exists()
    except OSError:
        return False


def _stand_for(child: int, unblocked: set[signal.Signals | int]) -> NoReturn:
    """Pass signals on to a child, with that signal mask, and end with its exit code."""

    def pass_on(number: int, _frame: object) -> None:
        stops = number == signal.SIGTSTP
        os.kill(child, signal.SIGSTOP if stops else number)  # not reaped yet: still its own
        if stops:
            os.kill(os.getpid(), signal.SIGSTOP)
            os.kill(child, signal.SIGCONT)

    for number in PASSED_ON:
        if number != signal.SIGHUP or signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, pass_on)
    signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    os._exit(code if code >= 0 else 128 - code)
