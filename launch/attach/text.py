"""What commands print: tables, whose last column is wrapped, facts, settings, and JSON."""

import json
import shutil
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sparseskin.messages.text import printable

Entry = Mapping[str, Any]
"""A setting as `Settings.described` describes it; of a running node with its value."""
GAP = "  "
MIN_LAST = 20
"""A last column is not made narrower than this, however narrow the terminal."""
MAX_SHOWN = 200
"""Longest value in a table, characters; a longer one (as the text of a launch file) is cut."""
_TYPES = {
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "str": "a text",
    "None": "none",
    "tuple[str, ...]": "a list of texts",
    "dict[str, Any]": "a table {KEY = VALUE}",
}


def formatted(name: str, fields: Mapping[str, Any]) -> dict[str, Any]:
    """A document of a format of docs/reference/json.toml: "format" is "sparseskin/NAME/VERSION", a
    version 1 more where a field goes or changes its meaning.
    """
    return {"format": f"sparseskin/{name}/1", **fields}


def width() -> int:
    """Columns of the terminal; 80 where there is none."""
    return shutil.get_terminal_size().columns


def size_text(n_bytes: float) -> str:
    """A number of bytes in the unit that fits."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if n_bytes >= size:
            return f"{n_bytes / size:.2f} {unit}"
    return f"{n_bytes:.0f} B"


def flowing(text: str) -> str:
    """A text as printable words, one space between them."""
    return " ".join(printable(text).split())


def table(
    head: Sequence[str], rows: Sequence[Sequence[object]], indent: str = ""
) -> list[str]:
    """Lines of a table, each after `indent`; columns of numbers, None: not known, flush right."""
    texts = [[flowing(_cell(cell)) for cell in row] for row in rows]
    # Flush right where all cells of a column are numbers.
    columns = []
    for k, title in enumerate(head):
        lengths = [len(line[k]) for line in texts]
        longest = max([len(title), *lengths])
        is_right = bool(rows) and all(_is_number(row[k]) for row in rows)
        columns.append((longest, is_right))

    lines: list[str] = []
    for cells in [list(head), *texts]:
        padded = []
        for cell, (longest, is_right) in zip(cells, columns, strict=True):
            if is_right:
                padded.append(cell.rjust(longest))
            else:
                padded.append(cell.ljust(longest))
        start = indent + "".join(cell + GAP for cell in padded[:-1])
        _, is_right = columns[-1]
        if is_right:
            lines.append(start + padded[-1])
        else:
            lines += wrapped(start, cells[-1])
    return lines


def _is_number(cell: object) -> bool:
    # bool is a subclass of int, but no number to a reader.
    if isinstance(cell, bool):
        return False
    return cell is None or isinstance(cell, int | float)


def _cell(cell: object) -> str:
    if cell is None:
        return "-"
    if isinstance(cell, float):
        return f"{cell:.2f}"
    return str(cell)


def wrapped(start: str, text: str, continued: str | None = None) -> list[str]:
    """`start` and a text, wrapped to the terminal; further lines begin with `continued`, by
    default with as many spaces as `start` has characters.
    """
    if continued is None:
        continued = " " * len(start)
    # The longer of both begins leaves the narrower column.
    room = max(MIN_LAST, width() - max(len(start), len(continued)))
    # A command or a path is to be copied: it is not broken.
    lines = textwrap.wrap(text, room, break_on_hyphens=False, break_long_words=False)
    if not lines:
        return [start.rstrip()]
    begin = (start + lines[0]).rstrip()
    return [begin, *(continued + line for line in lines[1:])]


def facts(named: Mapping[str, str], indent: str = "") -> list[str]:
    """Lines of names and texts, each text wrapped under itself."""
    lines: list[str] = []
    for name, text in named.items():
        lines += wrapped(f"{indent}{name:<10} ", flowing(text))
    return lines


def shown_value(value: Any) -> str:
    """A value as it would be typed; "none" where nothing is stated."""
    if value is None:
        return "none"
    text = json.dumps(value)
    if isinstance(value, str):
        n_lines = value.count("\n")
        if n_lines > 1:
            return f"({n_lines} lines: param get prints them)"
        # Without quotes, where these are not needed to see where it begins and ends.
        if value and value.isprintable() and value == value.strip():
            text = value
    if len(text) > MAX_SHOWN:
        return text[: MAX_SHOWN - 3] + "..."
    return text


def preset_of(entries: Iterable[Entry]) -> str | None:
    """The preset among the settings of a node; None where it has none."""
    for entry in entries:
        if entry["key"] == "preset":
            return str(entry["value"])
    return None


def in_force_text(entry: Entry, preset: str | None) -> str:
    """The value in force of a setting that is not stated, as " (preset NAME: VALUE)"; or ""."""
    if entry["value"] is not None or entry["in_force"] is None:
        return ""
    value = shown_value(entry["in_force"])
    if not preset:
        return f" (in force: {value})"
    return f" (preset {preset}: {value})"


def types_of(entry: Entry) -> list[str]:
    """Names of the types that a setting may have, as they are declared."""
    return [part.strip() for part in str(entry["type"]).split("|")]


def allowed_text(entry: Entry) -> str:
    """Allowed values of a setting, in a few words."""
    types = types_of(entry)
    # A closed list says all; else the types do.
    words = list(entry["choices"] or entry["known"])
    if words:
        if "None" in types:
            words.append("none")
        return ", ".join(words)

    for name in types:
        word = _TYPES.get(name, name)
        if name in ("int", "float"):
            word += _range_text(entry)
        words.append(word)
    return " or ".join(words)


def typed_value(text: str, entry: Entry | None) -> Any:
    """The value of a typed text: TOML, or else the text as it stands, as it does for a setting
    whose described type is a text.
    """
    # Imported here: with it comes numpy, for which a table need not wait.
    from sparseskin.nodes.toml import toml_or_text

    types = []
    if entry is not None:
        types = types_of(entry)
    if text == "none" and "None" in types:
        return None
    # A text needs no quotes at a prompt.
    value = toml_or_text(text)
    if isinstance(value, str):
        return value
    is_text = bool(types) and set(types) <= {"str", "None"}
    if is_text or not isinstance(value, bool | int | float | list | dict):
        return text
    return value


def _range_text(entry: Entry) -> str:
    low = entry["low"]
    high = entry["high"]
    if low is not None and high is not None:
        return f" {_number(low)}..{_number(high)}"
    if low is not None:
        return f", {_number(low)} or more"
    if high is not None:
        return f", {_number(high)} or less"
    return ""


def _number(value: float) -> str:
    if value == round(value) and abs(value) < 1e12:
        return f"{value:.0f}"
    return f"{value:g}"
