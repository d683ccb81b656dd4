"""Settings as a person reads and types them, and tables that fit the terminal."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.launch.attach.text import MAX_SHOWN, allowed_text, shown_value, table, typed_value


def entry(type_, **stated):
    return {"type": type_, "low": None, "high": None, "choices": [], "known": [], **stated}


@pytest.mark.parametrize(
    ("described", "allowed"),
    [
        (entry("int", low=1, high=1048576), "a whole number 1..1048576"),
        (entry("float", low=0), "a number, 0 or more"),
        (entry("bool"), "true or false"),
        (entry("str | None", known=["a", "b"]), "a, b, none"),
    ],
)
def test_what_a_setting_may_be_is_said_in_words(described, allowed):
    assert allowed_text(described) == allowed


@pytest.mark.parametrize(
    ("text", "type_", "value"),
    [
        ("3", "int", 3),
        ("true", "bool", True),
        ("12", "str", "12"),
        ("none", "float | None", None),
        ("none", "str", "none"),
        ('["/skin/taxels"]', "tuple[str, ...]", ["/skin/taxels"]),
        ("1\nb = 2", "int", 1),
    ],
)
def test_what_is_typed_is_toml_or_a_text(text, type_, value):
    assert typed_value(text, entry(type_)) == value
    assert type(typed_value(text, entry(type_))) is type(value)


@given(st.integers(-(10**12), 10**12) | st.booleans() | st.floats(-1e9, 1e9))
def test_a_number_that_is_shown_can_be_typed_again(value):
    assert typed_value(shown_value(value), entry(type(value).__name__)) == value


@given(st.text(max_size=50))
def test_any_text_is_shown_on_one_line_and_can_be_typed_again(value):
    shown = shown_value(value)
    assert len(shown.splitlines()) == 1
    if value.isprintable() and '"' not in value and "'" not in value:
        assert typed_value(shown, entry("str")) == value


def test_a_long_text_is_cut_and_of_one_of_many_lines_their_number_is_shown():
    assert len(shown_value("x" * 5000)) == MAX_SHOWN
    assert shown_value(None) == "none"
    assert shown_value("a\nb\nc\n") == "(3 lines: param get prints them)"


def test_the_last_column_is_wrapped_under_itself(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    lines = table(["KEY", "WHAT"], [["key", "many words " * 20]])
    assert all(len(line) <= 80 for line in lines)
    assert all(line.startswith("     many") or line.startswith("     words") for line in lines[2:])
