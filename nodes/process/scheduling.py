"""CPUs and real-time priority of a node's process."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from sparseskin.messages.ranges import is_whole
from sparseskin.nodes.errors import SettingsError

SCHEDULING_KEYS = ("cpus", "priority")
"""Keys of [graph], for all nodes, and of [nodes.NAME]."""
MAX_CPU = 1023
"""Largest number of a CPU (CPU_SETSIZE of sched_setaffinity(2))."""
MAX_PRIORITY = 98
"""Largest priority of a node; that of the threads of its sockets is 1 higher, 99 at most."""


@dataclass(frozen=True)
class Scheduling:
    """How the kernel schedules a node.

    Attributes
    ----------
    cpus : tuple of int
        Numbers of the CPUs on which it may run; none: all of the launcher.
    priority : int
        Real-time priority (SCHED_FIFO, sched(7)), 1..98; 0: it shares the CPUs with all others.
    """

    cpus: tuple[int, ...] = ()
    priority: int = 0

    def stated(self, key: str, value: Any) -> Scheduling:
        """The same with one key of a launch file.
        Raises SettingsError if the value is not allowed.
        """
        if key == "priority":
            if not is_whole(value, 0, MAX_PRIORITY):
                allowed = f"allowed: a whole number, 0..{MAX_PRIORITY}"
                raise SettingsError(f"{value!r} is not allowed ({allowed})")
            return replace(self, priority=value)
        numbers = value if isinstance(value, list) else []
        if not numbers or not all(is_whole(number, 0, MAX_CPU) for number in numbers):
            allowed = f"allowed: a list of numbers of CPUs, 0..{MAX_CPU}, as [0, 1]"
            raise SettingsError(f"{value!r} is not allowed ({allowed})")
        return replace(self, cpus=tuple(sorted(set(numbers))))

    def check_permitted(self) -> None:
        """Raise SettingsError, which begins with the key, if this process must not run so."""
        here = os.sched_getaffinity(0)
        if away := sorted(set(self.cpus) - here):
            text = f"CPU {away[0]} is not there for this process"
            raise SettingsError(f"cpus: {text} (allowed: {', '.join(map(str, sorted(here)))})")
        if not self.priority:
            return
        policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(self.priority + 1))
        except PermissionError as error:
            limit = f"a limit rtprio of {self.priority + 1} or more, as in limits.conf(5)"
            text = f"{self.priority} is not permitted to this user (allowed: 0; or {limit})"
            raise SettingsError(f"priority: {text}") from error
        finally:
            os.sched_setscheduler(0, policy, parameters)

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Schedule this process so, with the threads that start within the context. Those that
        start after it have no priority: a thread that serves a page must not hold up frames.

        Raises
        ------
        OSError
            If it is not permitted.
        """
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
