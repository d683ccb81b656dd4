"""Tables for a terminal: columns as wide as what stands in them, the last one wrapped."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Sequence

from sparseskin.messages.text import printable

GAP = "  "
MIN_LAST = 20
"""A last column is not made narrower than this, however narrow the terminal."""


def width() -> int:
    """Columns of the terminal; 80 where there is none."""
    return shutil.get_terminal_size().columns


def flowing(text: str) -> str:
    """A text as printable words, one space between them."""
    return " ".join(printable(text).split())


def table(head: Sequence[str], rows: Sequence[Sequence[object]], indent: str = "") -> list[str]:
    """Lines of a table, each after `indent`; columns of whole numbers are flush right."""
    shown = [[flowing(str(cell)) for cell in row] for row in rows]
    widths = [max(len(line[k]) for line in [head, *shown]) for k in range(len(head))]
    right = [
        bool(rows) and all(isinstance(row[k], int) and not isinstance(row[k], bool) for row in rows)
        for k in range(len(head))
    ]
    lines: list[str] = []
    for cells in [list(head), *shown]:
        start = indent + "".join(
            (cell.rjust(w) if flush else cell.ljust(w)) + GAP
            for cell, w, flush in zip(cells[:-1], widths[:-1], right[:-1], strict=True)
        )
        last = cells[-1]
        lines += [start + last.rjust(widths[-1])] if right[-1] else wrapped(start, last)
    return lines


def wrapped(start: str, text: str, continued: str | None = None) -> list[str]:
    """`start` and a text, wrapped to the terminal; further lines begin with `continued`, by
    default with as many spaces as `start` has characters.
    """
    continued = " " * len(start) if continued is None else continued
    room = max(MIN_LAST, width() - max(len(start), len(continued)))
    first, *rest = textwrap.wrap(text, room, break_on_hyphens=False, break_long_words=False) or [""]
    return [(start + first).rstrip(), *(continued + line for line in rest)]
