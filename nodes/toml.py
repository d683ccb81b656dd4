"""TOML from elsewhere: bounded in size, depth and numbers, so that checking it is bounded too."""

import re
import tomllib
from typing import Any

from sparseskin.messages.ranges import INT64_MAX

MAX_CHARS = 1 << 16
"""Longest launch file: that of a graph of some hundred nodes."""
MAX_DEPTH = 8
"""Most tables and lists within each other."""
MAX_DOTS = 100
"""Most dots in a key, or in a run of what may be one."""
_NO_KEY = re.compile(r"[^\w\s.\"'-]")
_LONG = re.compile(r"[0-9_]{1000,}")


def toml_or_text(text: str) -> Any:
    """The value that a person has typed: TOML, or else the text as it stands."""
    try:
        return parse_toml(f"value = {text}")["value"]
    except ValueError:
        return text


def parse_toml(text: str, max_chars: int = MAX_CHARS) -> dict[str, Any]:
    """Parse TOML.
    Raises ValueError in one line if it is none, longer than `max_chars`, too deep, or holds a whole
    number beyond 64 bits.
    """
    if len(text) > max_chars:
        raise ValueError(f"more than {max_chars} characters")
    for number, line in enumerate(text.splitlines(), start=1):
        # The time that a parser takes for a key grows with the square of its parts.
        keys = _NO_KEY.split(line)
        if any(key.count(".") > MAX_DOTS for key in keys):
            raise ValueError(
                f"a key of more than {MAX_DOTS} parts (at line {number}, column 1)"
            )
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise ValueError(
            f"more than {MAX_DEPTH} tables or lists within each other"
        ) from None
    # int() refuses thousands of digits, and names no place.
    except ValueError as error:
        line_number = 1
        digits = _LONG.search(text)
        if digits is not None:
            line_number += text.count("\n", 0, digits.start())
        raise ValueError(
            f"a whole number beyond 64 bits (at line {line_number}, column 1)"
        ) from error

    # Without recursion, which a deep tree could exhaust.
    waiting: list[tuple[tuple[str, ...], Any]] = [((), tree)]
    while waiting:
        place, value = waiting.pop()
        where = ".".join(place)[:80]
        if len(place) > MAX_DEPTH:
            raise ValueError(
                f"{where}: more than {MAX_DEPTH} tables or lists in each other"
            )
        if isinstance(value, int) and not -INT64_MAX - 1 <= value <= INT64_MAX:
            raise ValueError(f"{where}: a whole number beyond 64 bits")
        if isinstance(value, list):
            value = {str(number): part for number, part in enumerate(value)}
        if isinstance(value, dict):
            waiting += [((*place, key), part) for key, part in value.items()]
    return tree
