"""Tables fit the terminal, and nothing in them moves the cursor."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.launch.attach.text import flowing, table


@pytest.fixture(autouse=True)
def eighty_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


def test_columns_are_as_wide_as_what_stands_in_them_and_numbers_flush_right() -> None:
    rows = [["sensor", 5, "a"], ["compressor", 12345, "bb"]]
    assert table(["NODE", "SENT", "READ BY"], rows) == [
        "NODE         SENT  READ BY",
        "sensor          5  a",
        "compressor  12345  bb",
    ]


def test_the_last_column_is_wrapped_under_itself() -> None:
    lines = table(["KEY", "WHAT"], [["key", "many words " * 20]])
    assert all(len(line) <= 80 for line in lines)
    assert all(line.startswith("     many") or line.startswith("     words") for line in lines[2:])


@given(st.text(max_size=80))
def test_what_is_printed_is_one_line_without_control_characters(text: str) -> None:
    assert flowing(text).isprintable()
