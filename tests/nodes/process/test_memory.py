"""When memory is looked through for what is free."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest

from sparseskin.nodes.process import memory
from sparseskin.nodes.process.memory import GROWN_BYTES, MOST_CALLS, STARTED_CALLS, FreeMemory

LEAST = 50_000_000


def looks(monkeypatch: pytest.MonkeyPatch, resident: Iterator[int]) -> Iterator[bool]:
    """True if each call reads the resident memory, once all has started."""
    monkeypatch.setattr(memory, "STARTED_CALLS", 0)
    n_looks: list[int] = []
    monkeypatch.setattr(memory, "_trim", lambda: n_looks.append)
    monkeypatch.setattr(memory, "resident_bytes", lambda _pid: next(resident))
    free = FreeMemory()
    while True:
        before = len(n_looks)
        try:
            free.trim()
        except StopIteration:
            return
        yield len(n_looks) > before


def test_memory_that_stays_in_use_is_looked_through_ever_more_seldom(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    resident = [LEAST, *[LEAST + 2 * GROWN_BYTES] * 1000]
    found = [k for k, look in enumerate(looks(monkeypatch, iter(resident))) if look]
    assert found[:7] == [1, 3, 7, 15, 31, 63, 127]
    assert {b - a for a, b in itertools.pairwise(found[6:])} == {MOST_CALLS}


def test_memory_that_is_back_at_its_least_is_looked_through_at_once_when_it_grows_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grown = LEAST + 2 * GROWN_BYTES
    resident = [LEAST, *[grown] * 5, LEAST - 9, LEAST + GROWN_BYTES // 2, grown, grown]
    found = [k for k, look in enumerate(looks(monkeypatch, iter(resident))) if look]
    assert found == [1, 3, 8]


def test_memory_of_the_start_is_freed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    n_looks: list[int] = []
    monkeypatch.setattr(memory, "_trim", lambda: n_looks.append)
    monkeypatch.setattr(memory, "resident_bytes", lambda _pid: LEAST)
    free = FreeMemory()
    for _ in range(STARTED_CALLS - 1):
        free.trim()
    assert not n_looks
    for _ in range(100):
        free.trim()
    assert len(n_looks) == 1


def test_a_library_without_malloc_trim_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_trim", lambda: None)
    monkeypatch.setattr(memory, "resident_bytes", lambda _pid: pytest.fail("nothing to look for"))
    FreeMemory().trim()
