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
LOADS = "500g, 0.5kg, 4.9N or 800mN"
AREAS = "all, or ROWSxCOLUMNS as 4-11x8-15"


class CalibrationError(SparseskinError):
    """Frames from which no calibration follows."""


@dataclass(frozen=True, eq=False)
class Press:
    """Frames of a skin under a known load."""

    label: str  # for reports, e.g. "500g"
    force: float  # total, newtons, above 0
    frames: npt.NDArray[Any]  # (n, rows, cols), raw readings under the steady load
    #: (rows, cols), True for the cells that carry the load evenly; None: only the total is known.
    area: Mask | None = None


def read_load(text: str) -> float:
    """Newtons of a load such as "500g" or "4.9N".
    Raises CalibrationError if it is none, or 0.
    """
    found = _LOAD.fullmatch(text.strip())
    force = float(found[1]) * NEWTONS[found[2]] if found else 0.0
    if not force:
        raise CalibrationError(f"{text[:40]!r} is no load; allowed are {LOADS}")
    return force


def read_area(text: str, shape: tuple[int, int]) -> Mask:
    """Cells of an area such as "all" or "4-11x8-15", ends included, from 0, as of `Press`.
    Raises CalibrationError if it is none, or not on a skin of that shape.
    """
    if text.strip() == "all":
        return np.ones(shape, dtype=np.bool_)
    found = _AREA.fullmatch(text.strip())
    if found is None:
        raise CalibrationError(f"{text[:40]!r} is no area; allowed are {AREAS}")
    top, bottom, left, right = map(int, found.groups())
    if not (top <= bottom < shape[0] and left <= right < shape[1]):
        raise CalibrationError(f"{text} is not on a skin of {shape[0]} x {shape[1]}")
    area = np.zeros(shape, dtype=np.bool_)
    area[top : bottom + 1, left : right + 1] = True
    return area
