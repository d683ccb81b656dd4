"""When freed memory is returned to the system."""

import resource

from sparseskin.nodes.process import memory
from sparseskin.nodes.process.memory import EVERY, GROWN_BYTES, FreeMemory

LEAST = 50_000_000


def test_memory_is_trimmed_after_the_start_and_every_20th_call_while_it_is_grown(monkeypatch):
    trims = []
    resident = LEAST
    monkeypatch.setattr(memory, "resident_bytes", lambda _pid: resident)
    free = FreeMemory()
    monkeypatch.setattr(free, "_trim", trims.append)
    found = []
    for resident in (  # noqa: B007 - read by resident_bytes
        LEAST,
        LEAST,
        LEAST + 2 * GROWN_BYTES,
        LEAST + 2 * GROWN_BYTES,
        LEAST - 9,
    ):
        for _ in range(EVERY):
            free.trim()
        found.append(len(trims))
    assert found == [1, 1, 2, 3, 3]


def test_memory_is_not_looked_through_while_no_file_can_be_opened():
    free, limits = FreeMemory(), resource.getrlimit(resource.RLIMIT_NOFILE)
    free.trim()
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, limits[1]))
    try:
        for _ in range(EVERY):
            free.trim()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
