"""Settings as text: a value, its allowed values, and the value of a typed text."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from sparseskin.launch.launchfile.toml import parse_toml

MAX_SHOWN = 200
"""Longest value in a table, characters; a longer one (as the text of a launch file) is cut."""
_TYPES = {
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "str": "a text",
    "None": "none",
    "tuple[str, ...]": "a list of texts",
}


def shown_value(value: Any) -> str:
    """A value as it would be typed; "none" where nothing is stated."""
    if value is None:
        return "none"
    if isinstance(value, str) and value.count("\n") > 1:
        return f"({value.count(chr(10))} lines: param get prints them)"
    if isinstance(value, str) and value and value.isprintable() and value == value.strip():
        text = value
    else:
        text = json.dumps(value)
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 3] + "..."


def preset_of(entries: Iterable[Mapping[str, Any]]) -> str | None:
    """The preset among the settings of a node; None where it has none."""
    return next((str(entry["value"]) for entry in entries if entry["key"] == "preset"), None)


def in_force_text(entry: Mapping[str, Any], preset: str | None) -> str:
    """The value in force of a setting that is not stated, as " (preset NAME: VALUE)"; or ""."""
    if entry["value"] is not None or entry["in_force"] is None:
        return ""
    whose = f"preset {preset}" if preset else "in force"
    return f" ({whose}: {shown_value(entry['in_force'])})"


def types_of(entry: Mapping[str, Any]) -> list[str]:
    """Names of the types that a setting may have, as they are declared."""
    return [part.strip() for part in str(entry["type"]).split("|")]


def allowed_text(entry: Mapping[str, Any]) -> str:
    """Allowed values of a setting, in a few words."""
    if entry["choices"]:
        return ", ".join(entry["choices"])
    if entry["known"]:
        return ", ".join([*entry["known"], *(["none"] if "None" in types_of(entry) else [])])
    words = []
    for name in types_of(entry):
        word = _TYPES.get(name, name)
        words.append(word + _range_text(entry) if name in ("int", "float") else word)
    return " or ".join(words)


def typed_value(text: str, entry: Mapping[str, Any] | None) -> Any:
    """The value of a typed text: TOML, or else the text as it stands, as it does for a setting
    whose described type is a text.
    """
    types = types_of(entry) if entry is not None else []
    if text == "none" and "None" in types:
        return None
    try:
        value = parse_toml(f"value = {text}")["value"]
    except ValueError:
        return text
    plain = isinstance(value, str | bool | int | float | list)
    if not plain or (not isinstance(value, str) and set(types) <= {"str", "None"} and types):
        return text
    return value


def _range_text(entry: Mapping[str, Any]) -> str:
    low, high = entry["low"], entry["high"]
    if low is not None and high is not None:
        return f" {_number(low)}..{_number(high)}"
    if low is not None:
        return f", {_number(low)} or more"
    return f", {_number(high)} or less" if high is not None else ""


def _number(value: float) -> str:
    return f"{value:.0f}" if value == round(value) and abs(value) < 1e12 else f"{value:g}"
