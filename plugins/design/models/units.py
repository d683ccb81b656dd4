"""Quantities with units, read strictly: "4mm", "0.01N", "1kHz", "20M"."""

from __future__ import annotations

import math
import re

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.sensor.files.recording import shown

LENGTH = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "um": 1e-6}
FORCE = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
RATE = {"Hz": 1.0, "kHz": 1e3, "": 1.0}
CLOCK = {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "GHz": 1e9}
TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
SAMPLES = {"S/s": 1.0, "kS/s": 1e3, "MS/s": 1e6}
BITS_A_SECOND = {"": 1.0, "k": 1e3, "M": 1e6, "G": 1e9}
"""Units of each kind of quantity, and their size in SI units."""

_QUANTITY = re.compile(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)\s*([a-zA-Z/]*)", re.ASCII)
_MAX_CHARS = 40


def quantity(text: object, units: dict[str, float], example: str, low: float, high: float) -> float:
    """Return a quantity in SI units: a decimal number of at most 40 characters and one of `units`,
    which have their size in SI units ("": none is needed). Raises SettingsError, with an `example`,
    if the text has another form or unit, or the value is not in low..high.
    """
    found = _QUANTITY.fullmatch(text) if isinstance(text, str) and len(text) <= _MAX_CHARS else None
    if found is None:
        raise SettingsError(f"{shown(text)}: expected a number with its unit, such as {example}")
    number, unit = found.groups()
    if unit not in units:
        known = [name for name in units if name]
        what = f"unit {unit!r} is not known{nearest_of(unit, known)}" if unit else "has no unit"
        raise SettingsError(f"{shown(text)}: {what}; expected such as {example}")
    value = float(number) * units[unit]
    if not (math.isfinite(value) and low <= value <= high):
        least, most = (f"{bound / units[unit]:.6g} {unit}".strip() for bound in (low, high))
        raise SettingsError(f"{shown(text)}: is outside {least} .. {most}")
    return value
