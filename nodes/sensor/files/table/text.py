"""Lines of a text file by pieces, and the cells of a line."""

from __future__ import annotations

import codecs
import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import IO, Any, NamedTuple

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
    r"(?(open)\]|(?:->|=>|:(?=\s*[\[(])))\s*(?![\],;])"
)
"""A time before the readings, as in "10:15:02.120 -> 1,2,3", "[10:15:02.120] 1,2,3" or
"0.25: [1, 2, 3]"."""
LABEL = re.compile(r"\D[^,;|\t]*?[:>]\s*(?=[-+.\d])")
"""A text before the readings that ends so, as in "I (120) SKIN: 1,2,3"."""
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?![\w.])")
LIST = re.compile(r"(?:[A-Za-z_.]+\((?:'\w+',)?\s*)?\[([^\[\]]*)\](?:,\s*dtype=\w+)?\)?")
"""A list of numbers, perhaps as Python prints an array of them."""
BRACKETS = str.maketrans("", "", "[](){}")
PAIR = re.compile(
    r"([A-Za-z_][\w.\[\]-]*)\s*[:=]\s*([^\s,;|]+)"
    r"(?:\s+[A-Za-zµ%°/²]+(?=\s*[,;|]|$))?[\s,;|]*"
)
"""A value behind its name, as in "t=120 s0=5" or "t: 20 ms, s0: 5"."""
GROUPED = re.compile(r"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d+)?")
"""A number whose thousands are apart."""
UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
COMMENTS = ("#", "%", "//")


class Piece(NamedTuple):
    """Lines in a row, without their ends, and the number of the first one, from 1. `is_cut` is True
    if the last one is the last of the file and has no end.
    """

    lines: list[str]
    number: int
    is_cut: bool


class Dialect(NamedTuple):
    """How the cells of a line are separated; " " for any white space. `names` are those that each
    line states beside its values, () where it states none.
    """

    separator: str
    has_decimal_comma: bool = False
    has_prefix: bool = False
    has_brackets: bool = False
    has_quotes: bool = False
    names: tuple[str, ...] = ()

    @property
    def is_plain(self) -> bool:
        """True if NumPy reads its lines of numbers as they are."""
        return not (
            self.has_decimal_comma
            or self.has_prefix
            or self.has_brackets
            or self.has_quotes
            or self.names
        )

    def cells(self, line: str) -> list[str]:
        """The cells of a line."""
        prefix = ""
        if self.has_prefix:
            matched = PREFIX.match(line)
            if matched:
                prefix = matched[1].strip()
                line = line[matched.end() :]
        if self.names:
            values = named_values(line)
            # The values of other names are none of these columns.
            cells = list(values.values()) if tuple(values) == self.names else []
        else:
            if self.has_brackets:
                line = line.translate(BRACKETS).replace('"', "")
            cells = self._split(line)
        if self.has_decimal_comma:
            cells = [cell.replace(",", ".") for cell in cells]
        if self.has_prefix:
            return [prefix, *cells]
        return cells

    def _split(self, line: str) -> list[str]:
        if self.separator == " ":
            if self.has_brackets:
                line = line.replace(",", " ")
            return line.split()
        if '"' not in line:
            return [cell.strip() for cell in line.split(self.separator)]
        try:
            row = next(
                csv.reader([line], delimiter=self.separator, skipinitialspace=True)
            )
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
    names = Counter(tuple(named_values(body)) for body in bodies)
    usual_names, n_lines = names.most_common(1)[0]
    if usual_names and 2 * n_lines > len(bodies):
        return Dialect(",", has_prefix=has_prefix, names=usual_names)
    has_brackets = _are_most(
        bodies, lambda line: re.search(r"[\[({]\s*[-+.\d]", line) is not None
    )
    separator = _separator(bodies)
    has_decimal_comma = separator in (";", "\t", " ") and _have_decimal_commas(
        bodies, separator
    )
    if separator == " " and has_brackets and any("," in body for body in bodies):
        separator = ","
    has_quotes = any('"' in line for line in lines)
    return Dialect(separator, has_decimal_comma, has_prefix, has_brackets, has_quotes)


def named_values(line: str) -> dict[str, str]:
    """The values of a line that names each of them, as texts: an object of JSON, whose entries are
    named as field[0] and field.name, or pairs as "s0:5, s1:7"; {} of other lines.
    """
    values: dict[str, str] = {}
    if line.lstrip().startswith("{"):
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
    return values if at == len(line.strip()) else {}


def _add_values(values: dict[str, str], name: str, content: Any) -> None:
    """Add the values in a content of JSON, each by the path to it."""
    if isinstance(content, dict):
        for key, entry in content.items():
            _add_values(values, f"{name}.{key}" if name else key, entry)
    elif isinstance(content, list):
        for k, entry in enumerate(content):
            _add_values(values, f"{name}[{k}]", entry)
    elif content is None:
        values[name] = ""
    else:
        values[name] = str(content)


def _separator(lines: Sequence[str]) -> str:
    """The separator that stands in most lines."""
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


def _have_decimal_commas(lines: Sequence[str], separator: str) -> bool:
    split = None if separator == " " else separator
    cells = [cell.strip(' "') for line in lines for cell in line.split(split)]
    return any(re.fullmatch(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?", cell) for cell in cells)


def _are_most(lines: Sequence[str], holds: Callable[[str], bool]) -> bool:
    return 2 * sum(map(holds, lines)) > len(lines)


def _decoded(data: bytes) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")
