"""Tekscan sensors: the ASCII movie export (.csv, .asf), in its own unit."""

import re
from itertools import islice

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Doubles, Mask
from sparseskin.nodes.sensor.files.recording import (
    Block,
    Head,
    Lines,
    WholeRecording,
)
from sparseskin.nodes.sensor.layout.checks import parse_number, parse_whole, shown

from .movies import (
    LARGEST_NUMBER,
    check_mask,
    check_number,
    parse_shape,
    read_cells,
    stack_frames,
    stamps,
)

_FRAME = re.compile(r"Frame\s+(\d+)\s*(?:,\s*([^,]*))?")
_RAW_SUM = re.compile(r"Raw Sum=[\s,]*([^,\s]+)")
_METRES = {
    "mm": 1e-3,
    "millimeters": 1e-3,
    "cm": 1e-2,
    "centimeters": 1e-2,
    "m": 1.0,
    "meters": 1.0,
    "in": 0.0254,
    "inches": 0.0254,
}
_N_HEADER_LINES = 100
"""Lines searched for the end of the header, which has some 30 of them."""

Header = dict[str, tuple[str, str]]
"""From a keyword to its value and its place in the file, "FILE, line N, KEYWORD"."""


def is_tekscan(raw: bytes) -> bool:
    """True if the content has the keywords of a Tekscan header."""
    header_lines = raw[: 1 << 16].split(b"\n", _N_HEADER_LINES)[:_N_HEADER_LINES]
    return any(
        line.lstrip().startswith((b"DATA_TYPE", b"ASCII_DATA")) for line in header_lines
    )


class TekscanRecording(WholeRecording):
    """A Tekscan ASCII movie export.

    `B` marks a cell without a sensel: it is masked, and its value is 0. The times of the frames are
    used where all differ; they are printed to 0.01 s, so for fast recordings `SECONDS_PER_FRAME`
    counts. `forces` are float64, in the file's UNITS. Raises SourceError if a header or frame is
    missing, cut short or malformed, a reading is not a finite number >= 0, the mask changes, or a
    `Raw Sum` is not the sum of its frame.
    """

    def __init__(self, lines: Lines) -> None:
        super().__init__()
        self._lines = lines
        header, self._terminator = _parse_header(lines)
        rows = _entry(header, "ROWS", lines.name)
        cols = _entry(header, "COLS", lines.name)
        self._shape = parse_shape(rows, cols)
        self._unit, _ = _entry(header, "UNITS", lines.name)
        self._number = _number_of(header, "START_FRAME")
        self._last = _number_of(header, "END_FRAME")
        self._period_s = None
        if "SECONDS_PER_FRAME" in header:
            self._period_s = parse_number(*header["SECONDS_PER_FRAME"], 1e-9, 1e6)
        self._pitch_m = _pitch(header)
        self._mask: Mask | None = None
        self._times: list[float | None] = []
        self._first = self._next_frame()

    def read(self) -> tuple[Head, Block]:
        frames = []
        frame = self._first
        while frame is not None:
            frames.append(frame)
            frame = self._next_frame()

        forces = stack_frames(frames, self._lines.name)
        mask = self._mask
        assert self._number is not None
        if self._last is not None and self._number - 1 != self._last:
            raise SourceError(
                f"{self._lines.name}: the last frame is {self._number - 1}, "
                f"but END_FRAME is {self._last}"
            )
        rate_hz = None
        if self._period_s is not None:
            rate_hz = 1.0 / self._period_s
        head = Head(
            unit=self._unit,
            rate_hz=rate_hz,
            pitch_m=self._pitch_m,
            mask=None if mask is None or mask.all() else mask,
        )
        return head, Block(forces, stamps(self._times, self._lines.name))

    def _next_frame(self) -> Doubles | None:
        """Read the next frame: its readings, and its time into `_times`; None at the end mark."""
        for text in self._lines:
            line = text.strip(", \t")
            where = self._lines.where
            if not line:
                continue
            if self._terminator and line == self._terminator:
                self._check_end()
                return None

            match = _FRAME.match(line)
            if match is None:
                raise SourceError(
                    f"{where}: {shown(line)} stands where 'Frame N' should"
                )
            number = parse_whole(match[1], where, 0, LARGEST_NUMBER)
            # Frames are numbered from that in the header on, or from any.
            if self._number is not None:
                check_number(number, self._number, where)
            self._number = number + 1

            frame, exists = read_cells(self._lines, self._shape, number, "COLS", "B")
            if self._mask is None:
                self._mask = exists
            check_mask(self._mask, exists, number, where, "'B'")
            if self._unit.lower() == "raw":
                _check_raw_sum(line, float(frame.sum()), where, number)

            time_s = None
            if (match[2] or "").strip():
                time_s = parse_number(match[2], where)
            self._times.append(time_s)
            return frame
        if self._terminator:
            raise SourceError(
                f"{self._lines.name}: the file is cut short, "
                f"its end mark '{self._terminator}' is missing"
            )
        return None

    def _check_end(self) -> None:
        """Raise SourceError if a line that is not blank follows the end mark."""
        for text in self._lines:
            line = text.strip(", \t")
            if line:
                raise SourceError(
                    f"{self._lines.where}: {shown(line)} comes after the end mark "
                    f"'{self._terminator}'"
                )


def _parse_header(lines: Lines) -> tuple[Header, str]:
    """Read to the line before the frames: the keywords, and the end mark ("": none)."""
    header: Header = {}
    for line in islice(lines, _N_HEADER_LINES):
        # A spreadsheet that saved the file again filled each line up with commas.
        keyword, _, value = line.strip(", \t").partition(" ")
        header[keyword] = (value.strip(", \t"), f"{lines.where}, {keyword}")
        if keyword == "DATA_TYPE" and header[keyword][0] != "MOVIE":
            raise SourceError(
                f"{lines.where}: DATA_TYPE {shown(header[keyword][0])}; "
                "allowed is MOVIE (export the whole recording)"
            )
        if keyword == "ASCII_DATA":
            return header, header[keyword][0]
    raise SourceError(
        f"{lines.name}: no line ASCII_DATA; not a Tekscan ASCII movie export"
    )


def _number_of(header: Header, keyword: str) -> int | None:
    """The number of a frame; None if it is not stated."""
    if keyword not in header:
        return None
    return parse_whole(*header[keyword], 0, LARGEST_NUMBER)


def _entry(header: Header, keyword: str, name: str) -> tuple[str, str]:
    if not header.get(keyword, ("", ""))[0]:
        raise SourceError(f"{name}: the header states no {keyword}")
    return header[keyword]


def _pitch(header: Header) -> float | None:
    """Return the distance between sensels in m, or None if not stated, or not one for both axes."""
    pitches = []
    for keyword in ("ROW_SPACING", "COL_SPACING"):
        if keyword not in header:
            return None
        text, where = header[keyword]
        value, _, unit = text.partition(" ")
        metres = _METRES.get(unit.strip().lower())
        if metres is None:
            raise SourceError(
                f"{where}: unit {shown(unit)}; allowed are {', '.join(_METRES)}"
            )
        pitches.append(parse_number(value, where) * metres)
        if not 1e-6 <= pitches[-1] <= 10:
            raise SourceError(f"{where}: {shown(text)} is outside 0.001 mm..10 m")
    if pitches[0] != pitches[1]:
        return None
    return pitches[0]


def _check_raw_sum(line: str, total: float, where: str, number: int) -> None:
    match = _RAW_SUM.search(line)
    if match is None:
        return
    raw_sum = parse_number(match[1], where)
    if abs(raw_sum - total) > 0.5:
        raise SourceError(
            f"{where}: frame {number} states Raw Sum {raw_sum:g}, but its cells add up to {total:g}"
        )
