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
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def cpu_s(pid: int) -> float:
    """Processor time that a process has used, user and system, in seconds.

    As all functions here, it raises OSError if there is no such process.
    """
    fields = _stat(pid)
    return (int(fields[_UTIME]) + int(fields[_STIME])) / _TICK_HZ


def age_s(pid: int) -> float:
    """Seconds since a process was started, one tick of the kernel's clock at least."""
    up_s = float(Path("/proc/uptime").read_text().split()[0])
    started_s = int(_stat(pid)[_STARTTIME]) / _TICK_HZ
    return max(1 / _TICK_HZ, up_s - started_s)


def resident_bytes(pid: int) -> int:
    """Resident memory of a process, shared pages included."""
    fields = Path(f"/proc/{pid}/statm").read_text().split()
    return int(fields[1]) * _PAGE_BYTES


def own_bytes(pid: int) -> int:
    """Resident memory of a process, each shared page divided by the number of its users (PSS)."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return 1024 * next(
        int(line.split()[1]) for line in lines if line.startswith("Pss:")
    )


def host_busy_s() -> float:
    """Processor time that all processes of this host have used since it was started, in seconds."""
    first_line = Path("/proc/stat").read_text().partition("\n")[0]
    ticks = [int(field) for field in first_line.split()[1:]]
    idle, waits_for_disk = ticks[3:5]
    return (sum(ticks[:8]) - idle - waits_for_disk) / _TICK_HZ
