"""Figures of a process from /proc: processor time, memory, age."""

import os
from pathlib import Path

_TICK_HZ = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")

# Places in /proc/PID/stat after the name of the program (proc(5)).
_UTIME = 11
_STIME = 12
_STARTTIME = 19


def _stat(pid: int) -> list[str]:
    # The name of the program, in parentheses, may hold spaces and parentheses itself.
    text = Path(f"/proc/{pid}/stat").read_text()
    _, _, behind_name = text.rpartition(")")
    return behind_name.split()


def cpu_s(pid: int) -> float:
    """Processor time that a process has used, user and system, in seconds.

    As all functions here, it raises OSError if there is no such process.
    """
    fields = _stat(pid)
    n_ticks = int(fields[_UTIME]) + int(fields[_STIME])
    return n_ticks / _TICK_HZ


def age_s(pid: int) -> float:
    """Seconds since a process was started, one tick of the kernel's clock at least."""
    up, _ = Path("/proc/uptime").read_text().split()
    fields = _stat(pid)
    # Both since the host was started.
    started_s = int(fields[_STARTTIME]) / _TICK_HZ
    return max(1 / _TICK_HZ, float(up) - started_s)


def resident_bytes(pid: int) -> int:
    """Resident memory of a process, shared pages included."""
    fields = Path(f"/proc/{pid}/statm").read_text().split()
    return int(fields[1]) * _PAGE_BYTES
