"""Memory of a process, and processor time of this host, from /proc."""

import os
from pathlib import Path


def own_bytes(pid: int) -> int:
    """Resident memory of a process, each shared page divided by the number of its users (PSS)."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    # "Pss:   1234 kB", at the start of a line.
    _, _, from_pss = text.partition("\nPss:")
    n_kb, _ = from_pss.split(maxsplit=1)
    return 1024 * int(n_kb)


def host_busy_s() -> float:
    """Processor time that all processes of this host have used since it was started, in seconds."""
    first_line, _, _ = Path("/proc/stat").read_text().partition("\n")
    _, *fields = first_line.split()
    ticks = [int(field) for field in fields]
    idle, waits_for_disk = ticks[3:5]
    # Behind the first eight stands the time of guests, which is in the first two already.
    n_busy = sum(ticks[:8]) - idle - waits_for_disk
    return n_busy / os.sysconf("SC_CLK_TCK")
