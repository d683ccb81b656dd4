"""Lines of a text file by pieces, and the cells of a line."""

from __future__ import annotations

import codecs
import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from typing import IO, Any, NamedTuple, TypeVar

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.recording import MAX_LINE_BYTES

PIECE_BYTES = 1 << 21
"""Bytes of a piece; chosen: decoding them takes some ten milliseconds."""
FIRST_PIECE_BYTES = 1 << 18
"""Bytes of the first piece, of which the others have twice as many each; chosen: the first frame is
there sooner.
"""
SEPARATORS = (";", "\t", ",", "|")
PREFIX = re.compile(
    r"\s*(?P<open>\[)?((?:\d{4}-\d\d-\d\d[ T])?[\d:.,]+)\s*"
    r"(?(open)\]|(?:->|=>|:(?=\s*[\[(])))\s*(?=[^\s\],;])"
)
"""A time before the readings, as in "10:15:02.120 -> 1,2,3", "[10:15:02.120] 1,2,3" or
"0.25: [1, 2, 3]"."""
LABEL = re.compile(r"\D[^,;|\t]*?[:>]\s*(?=[-+.\d])")
"""A text before the readings that ends so, as in "I (120) SKIN: 1,2,3"."""
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?![\w.])")
LIST = re.compile(
    r"(?:[A-Za-z_.]+\((?:'\w+',)?\s*)?\[([^\[\]]*)\](?:,\s*dtype=\w+)?\)?"
)
"""A list of numbers, perhaps as Python prints an array of them."""
BRACKETS = str.maketrans("", "", "[](){}<>")
PAIR = re.compile(
    r"([A-Za-z_][\w.\[\]-]*)\s*[:=]\s*([^\s,;|]+)"
    r"(?:\s+[A-Za-zµ%°/²]+(?=\s*[,;|]|$))?[\s,;|]*"
)
"""A value behind its name, as in "t=120 s0=5" or "t: 20 ms, s0: 5"."""
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
GROUPED = re.compile(r"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d+)?")
"""A number whose thousands are apart."""
UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
COMMENT = re.compile(r"#(?!N/A|[A-Z]+(?:/0)?[!?])|%|//")
"""Begin of a comment; #N/A and #DIV/0! are readings that a spreadsheet does not have."""

_Any = TypeVar("_Any", str, tuple[str, ...], tuple[int, ...])


class Piece(NamedTuple):
    """Lines in a row, without their ends, and the number of the first one, from 1. `is_cut` is True
    if the last one is the last of the file and has no end.
    """

    lines: list[str]
    number: int
    is_cut: bool


class Dialect(NamedTuple):
    """How the cells of a line are separated; " " for any white space.

    `comma` is what stands for commas within numbers: "." or nothing; None: there are none.
    `label` is a text before the readings of each line, with # for the numbers in it. `names` are
    those that each line states beside its values. `lists` are the sizes of lists in the cells of a
    line, 0 of a cell that is none; () where no cell is a list.
    """

    separator: str
    comma: str | None = None
    has_prefix: bool = False
    label: str = ""
    has_brackets: bool = False
    has_quotes: bool = False
    names: tuple[str, ...] = ()
    lists: tuple[int, ...] = ()
    # Cells of a line; an empty one behind them is that of a separator at the end of the line.
    n_cells: int = 0

    @property
    def is_plain(self) -> bool:
        """True if NumPy reads its lines of numbers as they are."""
        return self == Dialect(self.separator, n_cells=self.n_cells)

    def cells(self, line: str) -> list[str]:
        """The cells of a line."""
        prefix: list[str] = []
        if self.has_prefix:
            matched = PREFIX.match(line)
            prefix = [""]
            if matched:
                prefix = [matched[2].strip()]
                line = line[matched.end() :]
        elif self.label:
            matched = LABEL.match(line)
            if matched and NUMBER.sub("#", matched[0]) == self.label:
                prefix = NUMBER.findall(matched[0])
                line = line[matched.end() :]
        if self.names:
            values = named_values(line)
            # The values of other names are none of these columns.
            cells: list[str] = []
            if tuple(values) == self.names:
                cells = list(values.values())
        else:
            cells = self._values(line)
        if self.comma is not None:
            cells = [cell.replace(",", self.comma) for cell in cells]
        cells = prefix + cells
        if len(cells) == self.n_cells + 1 and not cells[-1]:
            cells.pop()
        return cells

    def _values(self, line: str) -> list[str]:
        """The cells of what stands behind a prefix; those of a list are apart."""
        if not self.has_brackets:
            return split(line, self.separator)
        if self.lists and not LIST.search(line):
            # A header: the name of a list is that of its entries.
            names = split(line, self.separator)
            if len(names) == len(self.lists):
                entries = [
                    [f"{name}[{k}]" for k in range(size)] or [name]
                    for name, size in zip(names, self.lists, strict=True)
                ]
                return list(chain.from_iterable(entries))
        line = LIST.sub(lambda match: self._joined(match[1]), line)
        line = line.translate(BRACKETS).replace('"', "")
        if self.separator == " ":
            line = line.replace(",", " ")
        return split(line, self.separator)

    def _joined(self, content: str) -> str:
        return self.separator.join(re.split(r"[\s,;]+", content.strip(" ,;")))


def comment_mark(text: str) -> str:
    """The mark with which a comment begins, "" of other lines."""
    comment = COMMENT.match(text.lstrip())
    if comment is None:
        return ""
    return comment[0]


def is_body(text: str) -> bool:
    """True if a line is neither blank nor a comment. A header may begin with %."""
    return bool(text.strip()) and comment_mark(text) in ("", "%")


def split(line: str, separator: str) -> list[str]:
    """The cells of a line, without quotes and white space around them."""
    if separator == " ":
        return line.replace('"', "").split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    try:
        row = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    except (csv.Error, StopIteration):
        return []
    return [cell.strip() for cell in row]


def pieces(file: IO[bytes], name: str) -> Iterator[Piece]:
    """The lines of a file from its begin, by pieces. UTF-8, UTF-16 behind its mark, or Latin-1,
    which decodes every byte. Raises SourceError at a line of more than `MAX_LINE_BYTES`, or bytes
    of value 0.
    """
    file.seek(0)
    is_utf_16 = file.read(2) in UTF_16
    file.seek(0)
    if is_utf_16:
        recoded: Any = codecs.EncodedFile(file, "utf-8", "utf-16", errors="replace")
        file = recoded
    number = 1
    size = FIRST_PIECE_BYTES
    is_first = True
    # The whole file is never in memory: it may be larger.
    while data := file.read(size):
        size = min(2 * size, PIECE_BYTES)
        if not data.endswith(b"\n"):
            # A piece ends with a line.
            line_end = file.readline(MAX_LINE_BYTES)
            if len(line_end) == MAX_LINE_BYTES:
                line = number + data.count(b"\n")
                raise SourceError(
                    f"{name}, line {line}: is longer than {MAX_LINE_BYTES} bytes"
                )
            data += line_end
        if is_first:
            data = data.removeprefix(b"\xef\xbb\xbf")
            is_first = False
        if b"\0" in data:
            fault = "holds bytes of value 0; save it as UTF-8, or as UTF-16 with a mark"
            raise SourceError(f"{name}: not a text table in UTF-8: {fault}")
        text = _decoded(data)
        is_cut = not data.endswith((b"\n", b"\r"))
        # Not splitlines(), which also splits at form feeds and other controls.
        lines = re.split(r"\r\n|\n|\r", text)
        if not is_cut:
            lines.pop()
        yield Piece(lines, number, is_cut)
        number += len(lines)


def dialect_of(lines: Sequence[str]) -> Dialect:
    """The dialect of lines, of which most hold data."""
    has_prefix = _are_most(lines, lambda line: PREFIX.match(line) is not None)
    bodies = list(lines)
    if has_prefix:
        bodies = [PREFIX.sub("", line, count=1) for line in lines]
    names = _usual(tuple(named_values(body)) for body in bodies)
    if names:
        return Dialect(",", has_prefix=has_prefix, names=names)
    label = ""
    # A text that differs from line to line is a name, as of a taxel, and stays.
    if not has_prefix:
        matches = (LABEL.match(body) for body in bodies)
        label = _usual(NUMBER.sub("#", m[0]) if m else "" for m in matches)
        if label:
            bodies = [LABEL.sub("", body, count=1) for body in bodies]
    has_brackets = _are_most(
        bodies, lambda line: re.search(r"[\[({<]\s*[-+.\d]", line) is not None
    )
    separator = _separator(bodies)
    has_quotes = any('"' in line for line in lines)
    dialect = Dialect(separator, None, has_prefix, label, has_brackets, has_quotes)
    if not has_brackets:
        return dialect._replace(comma=_comma(bodies, separator))
    if separator == " " and any("," in body for body in bodies):
        separator = ","
    lists = _usual(tuple(_list_sizes(body, separator)) for body in bodies)
    if not any(lists):
        lists = ()
    return dialect._replace(separator=separator, lists=lists)


def _usual(values: Iterable[_Any]) -> _Any:
    """The value of most lines; an empty one if there is none."""
    counts = Counter(values)
    value, n_lines = counts.most_common(1)[0]
    if 2 * n_lines > counts.total():
        return value
    return type(value)()


def _list_sizes(line: str, separator: str) -> Iterator[int]:
    """Sizes of the lists in the cells of a line, 0 of a cell that is none."""
    mark = "\1"
    marked = LIST.sub(
        lambda match: mark * len(match[1].replace(",", " ").split()), line
    )
    for cell in split(marked, separator):
        yield cell.count(mark)


def _comma(lines: Sequence[str], separator: str) -> str | None:
    """What commas within the numbers of lines stand for: ".", nothing if they group thousands, or
    None where there are none.
    """
    cells = [cell.strip('" ') for line in lines for cell in split(line, separator)]
    if separator == ",":
        # As a spreadsheet writes numbers with commas: each in quotes.
        with_comma = [cell for cell in cells if "," in cell]
        if with_comma and all(map(GROUPED.fullmatch, with_comma)):
            has_point = any(re.fullmatch(r"[-+]?\d*\.\d+", cell) for cell in cells)
            if has_point:
                return ""
            return None
    is_decimal = any(re.fullmatch(DECIMAL_COMMA, cell) for cell in cells)
    if is_decimal and separator != "|":
        return "."
    return None


def named_values(line: str) -> dict[str, str]:
    """The values of a line that names each of them, as texts: an object of JSON, whose entries are
    named as field[0] and field.name, or pairs as "s0:5, s1:7"; {} of other lines.
    """
    values: dict[str, str] = {}
    if line.lstrip().startswith("{"):
        # A dictionary as Python prints it has other quotes.
        if '"' not in line:
            line = line.replace("'", '"')
        try:
            # Numbers stay as they are written: whole ones of any size are exact.
            content = json.loads(
                line, parse_float=str, parse_int=str, parse_constant=str
            )
        except (ValueError, RecursionError):
            return {}
        _add_values(values, "", content)
        return values
    at = 0
    for pair in PAIR.finditer(line.strip()):
        if pair.start() != at:
            return {}
        values[pair[1]] = pair[2]
        at = pair.end()
    if at < len(line.strip()):
        return {}
    return values


def _add_values(values: dict[str, str], name: str, content: Any) -> None:
    """Add the values in a content of JSON, each by the path to it."""
    if isinstance(content, dict):
        for key, entry in content.items():
            _add_values(values, f"{name}.{key}" if name else key, entry)
    elif isinstance(content, list):
        for k, entry in enumerate(content):
            _add_values(values, f"{name}[{k}]", entry)
    elif content is None:
        # As an empty cell: a reading that is missing.
        values[name] = ""
    else:
        values[name] = str(content)


def _separator(lines: Sequence[str]) -> str:
    """The separator that stands in most lines."""
    # Semicolons before commas, which may be decimal.
    for separator in SEPARATORS:
        n_lines = sum(separator in line for line in lines)
        is_decimal = separator == "," and _is_decimal(lines)
        if 2 * n_lines > len(lines) and not is_decimal:
            return separator
    return " "


def _is_decimal(lines: Sequence[str]) -> bool:
    """True if commas stand within numbers that white space separates."""
    rows = [cells for cells in map(str.split, lines) if len(cells) > 1]
    cells = [cell for row in rows for cell in row]
    numbers = [cell for cell in cells if re.fullmatch(r"[-+]?\d+,\d+", cell)]
    return 2 * len(rows) > len(lines) and 2 * len(numbers) > len(cells)


def _are_most(lines: Sequence[str], holds: Callable[[str], bool]) -> bool:
    return 2 * sum(map(holds, lines)) > len(lines)


def _decoded(data: bytes) -> str:
    # By pieces: a degree sign of Latin-1 in a comment does not change the rest.
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")
