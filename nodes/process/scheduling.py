"""CPUs and real-time priority of a node's process."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.settings import Settings, setting

MAX_CPU = 1023
"""Largest number of a CPU (CPU_SETSIZE of sched_setaffinity(2))."""
MAX_PRIORITY = 98
"""Largest priority of a node; that of the threads of its sockets is 1 higher, 99 at most."""


@dataclass(frozen=True)
class Scheduling(Settings):
    """How the kernel schedules a node: keys of [graph], for all nodes, and of [nodes.NAME]."""

    cpus: tuple[int, ...] = setting(
        (),
        "CPUs on which a node may run, as [0, 1]; []: all of the launcher",
        low=0,
        high=MAX_CPU,
    )
    priority: int = setting(
        0,
        "real-time priority (SCHED_FIFO); 0: it shares the CPUs",
        low=0,
        high=MAX_PRIORITY,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        # Frozen: nodes of one process are compared by what they state, in any order.
        object.__setattr__(self, "cpus", tuple(sorted(set(self.cpus))))

    def check_permitted(self) -> None:
        """Raise SettingsError, which begins with the key, if this process must not run so."""
        permitted = os.sched_getaffinity(0)
        missing = sorted(set(self.cpus) - permitted)
        if missing:
            text = f"CPU {missing[0]} is not there for this process"
            allowed = ", ".join(map(str, sorted(permitted)))
            raise SettingsError(f"cpus: {text} (allowed: {allowed})")
        if not self.priority:
            return

        # The kernel alone knows what it permits: the largest priority is tried, and taken back.
        policy = os.sched_getscheduler(0)
        parameters = os.sched_getparam(0)
        highest = self.priority + 1
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(highest))
        except PermissionError as error:
            raise SettingsError(
                f"priority: {self.priority} is not permitted to this user (allowed: 0; "
                f"or a limit rtprio of {highest} or more, as in limits.conf(5))"
            ) from error
        finally:
            os.sched_setscheduler(0, policy, parameters)

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Schedule this process so, with the threads that start within the context. Those that
        start after it have no priority: a thread that serves a page must not hold up frames.
        Raises OSError if it is not permitted.
        """
        # Threads that run already, as those of numpy, keep their own CPUs unless each is moved.
        if self.cpus:
            for thread in os.listdir("/proc/self/task"):
                os.sched_setaffinity(int(thread), self.cpus)
        if not self.priority:
            yield
            return
        parameters = os.sched_param(self.priority)
        os.sched_setscheduler(0, os.SCHED_FIFO, parameters)
        yield
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, parameters)
