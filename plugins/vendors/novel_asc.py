"""Novel pliance and pedar: the text export (.asc), a line of pressures a frame.

A pliance file ends with a table of the corners of its sensors; where they stand on a grid of equal
cells, that is the shape. The sensors of a pedar insole do not, and its file has no such table.
Source: files of both systems in the example data of the R package pressuRe (MIT).
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Doubles, Indices
from sparseskin.nodes.sensor.files.recording import (
    Head,
    Lines,
    Parsed,
    Recording,
    check_grid,
    parse_number,
    parse_reading,
    parse_whole,
    shown,
)

from .movies import KPA_CM2_IN_NEWTONS

_RATE = re.compile(r"scanning rate \[Hz\]:\s*(\S+)")
_UNIT = re.compile(r"pressure values in\s+(\S+)")
_HEAD_LINES = 20
_TOLERANCE = 0.02
"""Allowed distance of a sensor's middle from its place on the grid, in cells: rounding of 1 um."""
_LABELS = ("x[c]", "y[c]", "area")


class _Grid(NamedTuple):
    """Places of the sensors: the grid, the cell of each sensor, its area, and the pitch."""

    shape: tuple[int, int]
    rows: Indices
    cols: Indices
    area_cm2: Doubles
    pitch_m: float | None


class PlianceRecording(Recording):
    """A pliance export; frames are the lines below `time[secs]` whose first cell is a number.

    Row 0 is the one of largest y. Cells of the grid without a sensor are masked.

    `forces` are float64, newtons: pressure times sensor area. Raises SourceError if the file is no
    such export, its sensors form no grid (pedar), a line is malformed, or a reading is not a finite
    number >= 0.
    """

    def __init__(self, lines: Lines) -> None:
        self._name = lines.name
        self._lines = list(lines)  # the grid stands at the end of the file
        self._rate_hz, self._labels, self._start = _head(self._lines, self._name)
        self._grid = _grid(self._lines, self._labels, self._name)

    def head(self) -> Head:
        return Head(*self._grid.shape, len(self._labels), "N")

    def read(self) -> Parsed:
        grid, name = self._grid, self._name
        frames, times = [], []
        for number, line in enumerate(self._lines[self._start :], start=self._start + 1):
            cells = line.split()
            if not cells:
                break
            if cells[0] in ("MPP", "MVP"):  # pictures of maxima and means, below the frames
                continue
            where, n_cells = f"{name}, line {number}", 1 + len(self._labels)
            if len(cells) != n_cells:
                raise SourceError(f"{where}: holds {len(cells)} numbers, its header {n_cells}")
            times.append(parse_number(cells[0], where, 0, 1e9))
            kpa = [
                parse_reading(token, where, int(row), int(col))
                for token, row, col in zip(cells[1:], grid.rows, grid.cols, strict=True)
            ]
            frames.append(np.array(kpa) * grid.area_cm2 * KPA_CM2_IN_NEWTONS)
        if not frames:
            raise SourceError(f"{name}: the recording holds no frame")
        stamps = tuple(round((time - times[0]) * 1e9) for time in times)
        if any(after <= before for before, after in pairwise(stamps)):
            raise SourceError(f"{name}: the times of the frames do not rise")
        forces = np.zeros((len(frames), *grid.shape))
        forces[:, grid.rows, grid.cols] = np.stack(frames)
        mask = np.zeros(grid.shape, np.bool_)
        mask[grid.rows, grid.cols] = True
        return Parsed(
            forces=forces,
            unit="N",
            rate_hz=self._rate_hz,
            stamp_ns=stamps,
            pitch_m=grid.pitch_m,
            mask=None if mask.all() else mask,
        )


def _head(lines: list[str], name: str) -> tuple[float, list[str], int]:
    """Rate, numbers of the sensors, and the index of the first line of readings."""
    top = lines[:_HEAD_LINES]
    text = "\n".join(top)
    if not (text.startswith("file name:") and "scanning rate [Hz]" in text):
        raise SourceError(f"{name}: no line 'scanning rate [Hz]:'; not a pliance or pedar export")
    rate = next((match[1] for line in top if (match := _RATE.search(line))), "none")
    rate_hz = parse_number(rate, f"{name}, scanning rate", 1e-6, 1e6)
    unit = next((match[1] for line in top if (match := _UNIT.search(line))), "none")
    if unit != "kPa":
        raise SourceError(f"{name}: pressures in {shown(unit)}; allowed is kPa")
    start = next((k for k, line in enumerate(top) if line.lstrip().startswith("time[secs]")), None)
    if start is None:
        raise SourceError(f"{name}: no line 'time[secs]' with the numbers of the sensors")
    return rate_hz, lines[start].split()[1:], start + 1


def _grid(lines: list[str], labels: list[str], name: str) -> _Grid:
    # The table stands at the end of the file.
    begin = next((k for k in range(len(lines) - 1, -1, -1) if lines[k].startswith("corner")), None)
    if begin is None:
        raise SourceError(
            f"{name}: {len(labels)} sensors without a table of their corners, as an insole (pedar) "
            "has them; allowed: an export whose sensors form a grid (pliance)"
        )
    table: dict[str, tuple[list[str], str]] = {}
    for index in range(begin - 1, min(begin + 15, len(lines))):
        label, *cells = lines[index].split() or [""]
        table.setdefault(label, (cells, f"{name}, line {index + 1}"))
    for label in ("sensor", *_LABELS):
        if label not in table:
            raise SourceError(f"{name}, line {begin + 1}: the table of corners has no {label}")
        if len(table[label][0]) != len(labels):
            raise SourceError(
                f"{table[label][1]}: {len(table[label][0])} cells for {len(labels)} sensors"
            )
    for number in labels:
        parse_whole(number, f"{name}, number of a sensor", 0, 999_999)
    if table["sensor"][0] != labels or len(set(labels)) != len(labels):
        raise SourceError(f"{table['sensor'][1]}: the sensors are others than those of the frames")
    x_cm, y_cm, area = (
        np.array([parse_number(cell, table[label][1], -1e4, 1e4) for cell in table[label][0]])
        for label in _LABELS
    )
    if area.min() <= 0 or np.ptp(area) > 0.01 * area.max():
        raise SourceError(f"{table['area'][1]}: sensors of different size; allowed is a grid")
    cols, n_cols, width = _indices(x_cm, name, "x[c]")
    rows, n_rows, height = _indices(-y_cm, name, "y[c]")
    check_grid(n_rows, n_cols, name)
    if len(set(zip(rows.tolist(), cols.tolist(), strict=True))) != len(labels):
        raise SourceError(f"{name}: two sensors at one place of the grid")
    square = abs(width - height) < 0.01 * width
    return _Grid((n_rows, n_cols), rows, cols, area, width / 100 if square else None)


def _indices(places_cm: Doubles, name: str, label: str) -> tuple[Indices, int, float]:
    """Index of each sensor along one side, from 0; the number of cells, and the pitch in cm."""
    distinct = np.unique(places_cm.round(3))
    steps = np.diff(distinct)
    pitch = float(steps.min()) if steps.size else 1.0
    exact = (places_cm - distinct[0]) / pitch
    found = np.rint(exact).astype(np.intp)
    if pitch < 1e-3 or np.abs(exact - found).max() > _TOLERANCE or found.max() >= MAX_SIDE:
        raise SourceError(f"{name}: the sensors form no grid by their {label}; allowed is a grid")
    return found, int(found.max()) + 1, pitch
