"""Settings as a person reads and types them."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.launch.attach.text import (
    MAX_SHOWN,
    allowed_text,
    in_force_text,
    shown_value,
    typed_value,
)


def entry(type_: str, **stated: Any) -> dict[str, Any]:
    return {"type": type_, "low": None, "high": None, "choices": [], "known": [], **stated}


@pytest.mark.parametrize(
    ("described", "allowed"),
    [
        (entry("int", low=1, high=1048576), "a whole number 1..1048576"),
        (entry("float", low=0), "a number, 0 or more"),
        (entry("float | None", low=0.05, high=1), "a number 0.05..1 or none"),
        (entry("float", high=2), "a number, 2 or less"),
        (entry("bool"), "true or false"),
        (entry("tuple[str, ...]"), "a list of texts"),
        (entry("str", choices=["a", "b"]), "a, b"),
        (entry("str | None", known=["a", "b"]), "a, b, none"),
        (entry("str | None", choices=["a", "b"]), "a, b, none"),
    ],
)
def test_what_a_setting_may_be_is_said_in_words(described: dict[str, Any], allowed: str) -> None:
    assert allowed_text(described) == allowed


@pytest.mark.parametrize(
    ("text", "type_", "value"),
    [
        ("3", "int", 3),
        ("-0.5", "float", -0.5),
        ("true", "bool", True),
        ("fista", "str", "fista"),
        ('"fista"', "str", "fista"),
        ("12", "str", "12"),
        ("true", "str | None", "true"),
        ("none", "float | None", None),
        ("none", "str", "none"),
        ('["/skin/taxels"]', "tuple[str, ...]", ["/skin/taxels"]),
        ("2020-01-01", "str", "2020-01-01"),
        ("1\nb = 2", "int", 1),
        ("many", "float", "many"),
    ],
)
def test_what_is_typed_is_toml_or_a_text(text: str, type_: str, value: object) -> None:
    assert typed_value(text, entry(type_)) == value
    assert type(typed_value(text, entry(type_))) is type(value)


@given(st.integers(-(10**12), 10**12) | st.booleans() | st.floats(-1e9, 1e9))
def test_a_number_that_is_shown_can_be_typed_again(value: float) -> None:
    assert typed_value(shown_value(value), entry(type(value).__name__)) == value


@given(st.text(max_size=50))
def test_any_text_is_shown_on_one_line_and_can_be_typed_again(value: str) -> None:
    shown = shown_value(value)
    assert len(shown.splitlines()) == 1
    if value.isprintable() and '"' not in value and "'" not in value:
        assert typed_value(shown, entry("str")) == value


@pytest.mark.parametrize(
    ("value", "in_force", "preset", "text"),
    [
        (None, "skin", "skin", " (preset skin: skin)"),
        (None, 0.003125, "paper", " (preset paper: 0.003125)"),
        (None, 100.0, None, " (in force: 100.0)"),
        (None, None, "skin", ""),
        ("fista", "fista", "skin", ""),
    ],
)
def test_of_a_setting_that_is_not_stated_it_is_said_what_holds(
    value: object, in_force: object, preset: str | None, text: str
) -> None:
    assert in_force_text({"value": value, "in_force": in_force}, preset) == text


def test_a_long_text_is_cut() -> None:
    assert len(shown_value("x" * 5000)) == MAX_SHOWN
    assert shown_value(None) == "none"


def test_of_a_text_of_many_lines_their_number_is_shown() -> None:
    assert shown_value("a\nb\nc\n") == "(3 lines: param get prints them)"
