"""Known loads on a skin, for its calibration."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.numerics.arrays import Mask

GRAVITY = 9.80665
"""Standard acceleration of free fall, m/s^2. Source: ISO 80000-3."""
NEWTONS = {"kg": GRAVITY, "g": GRAVITY / 1000, "N": 1.0, "mN": 0.001}
"""Newtons of each unit of a load."""
_LOAD = re.compile(r"(\d{1,9}(?:\.\d{1,9})?) ?(kg|g|N|mN)")
_AREA = re.compile(r"(\d{1,4})-(\d{1,4})x(\d{1,4})-(\d{1,4})")
ALL = "all"
LOADS = "500g, 0.5kg, 4.9N or 800mN"
AREAS = "all, or ROWSxCOLUMNS as 4-11x8-15"

Area = tuple[int, int, int, int]
"""First and last row, first and last column, both included, from 0."""


class CalibrationError(SparseskinError):
    """Frames from which no calibration follows."""


@dataclass(frozen=True, eq=False)
class Press:
    """Frames of a skin under a known load.

    Attributes
    ----------
    label : str
        Name for reports, e.g. "500g".
    force : float
        Total force, newtons, above 0.
    frames : ndarray, shape (n, rows, cols)
        Raw readings under the steady load.
    area : Area or None
        The cells that carry the load evenly; None: only the total is known.
    """

    label: str
    force: float
    frames: npt.NDArray[Any]
    area: Area | None = None

    def cells(self, shape: tuple[int, int]) -> Mask:
        """Cells of the area, bool (rows, cols).
        Raises CalibrationError if it is not on the skin.
        """
        found = np.zeros(shape, dtype=np.bool_)
        if self.area is not None:
            _check_area(self.area, shape, self.label)
            top, bottom, left, right = self.area
            found[top : bottom + 1, left : right + 1] = True
        return found


@dataclass(frozen=True)
class PressResult:
    """A press as the calibrated skin measures it.

    Attributes
    ----------
    label : str
    force, measured : float
        Total force stated and measured, newtons; of an even load, the mean of the working taxels
        of the area times its cells.
    spread : float or None
        Standard deviation of the forces of the taxels under an even load, in their mean.
    spread_before : float or None
        The same of raw readings above the baseline.
    """

    label: str
    force: float
    measured: float
    spread: float | None = None
    spread_before: float | None = None


def read_load(text: str) -> float:
    """Newtons of a load such as "500g" or "4.9N".
    Raises CalibrationError if it is none, or 0.
    """
    found = _LOAD.fullmatch(text.strip())
    force = float(found[1]) * NEWTONS[found[2]] if found else 0.0
    if not force:
        raise CalibrationError(f"{text[:40]!r} is no load; allowed are {LOADS}")
    return force


def read_area(text: str, shape: tuple[int, int]) -> Area:
    """Cells of an area such as "all" or "4-11x8-15", as of `Press`.
    Raises CalibrationError if it is none, or not on a skin of that shape.
    """
    if text.strip() == ALL:
        return (0, shape[0] - 1, 0, shape[1] - 1)
    found = _AREA.fullmatch(text.strip())
    if found is None:
        raise CalibrationError(f"{text[:40]!r} is no area; allowed are {AREAS}")
    top, bottom, left, right = map(int, found.groups())
    _check_area((top, bottom, left, right), shape, text)
    return (top, bottom, left, right)


def _check_area(area: Area, shape: tuple[int, int], where: str) -> None:
    top, bottom, left, right = area
    if not (0 <= top <= bottom < shape[0] and 0 <= left <= right < shape[1]):
        raise CalibrationError(
            f"{where}: {top}-{bottom}x{left}-{right} is not on a skin of {shape[0]} x {shape[1]}"
        )
