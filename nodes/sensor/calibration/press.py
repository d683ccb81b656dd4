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
    area : (int, int, int, int) or None
        First and last row, first and last column, both included, from 0, that carry the load
        evenly; None: only the total is known.
    """

    label: str
    force: float
    frames: npt.NDArray[Any]
    area: tuple[int, int, int, int] | None = None

    def cells(self, shape: tuple[int, int]) -> Mask:
        """Cells of the area, bool (rows, cols).

        Raises
        ------
        CalibrationError
            If the area is not on the skin.
        """
        found = np.zeros(shape, dtype=np.bool_)
        if self.area is not None:
            top, bottom, left, right = self.area
            if not (0 <= top <= bottom < shape[0] and 0 <= left <= right < shape[1]):
                raise CalibrationError(
                    f"{self.label}: rows {top}-{bottom}, columns {left}-{right} are not on a skin "
                    f"of {shape[0]} x {shape[1]}"
                )
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


def read_area(text: str, shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """Cells of an area such as "all" or "4-11x8-15", as of `Press`.
    Raises CalibrationError if it is none, or not on a skin of that shape.
    """
    n_rows, n_cols = shape
    found = _AREA.fullmatch(text.strip())
    if text.strip() == ALL:
        return (0, n_rows - 1, 0, n_cols - 1)
    if found is None:
        raise CalibrationError(f"{text[:40]!r} is no area; allowed are {AREAS}")
    top, bottom, left, right = (int(one) for one in found.groups())
    if not (top <= bottom < n_rows and left <= right < n_cols):
        raise CalibrationError(f"{text}: is not on a skin of {n_rows} x {n_cols}")
    return (top, bottom, left, right)
