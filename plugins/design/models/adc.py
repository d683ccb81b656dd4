"""Time that the converters of a skin take for a frame."""

from __future__ import annotations

import re
from dataclasses import dataclass

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.sensor.files.recording import shown

from .units import SAMPLES, quantity

FORM = "10bit@200kS/s"
_ADC = re.compile(r"(\d{1,2})\s*bits?\s*@\s*(.+)", re.ASCII)


@dataclass(frozen=True)
class Adc:
    """Converters behind multiplexers.

    Those that run at once share the conversions of a frame: t = ceil(conversions / converters) (1 /
    rate + settling); `bits` of a reading, 4..24; `rate_hz` of one converter by its data sheet;
    `settling_s` after the multiplexer has switched, which through a resistance R into a capacitance
    C to half a step of B bits is (B + 1) R C ln 2.
    """

    bits: int
    rate_hz: float
    converters: int = 1
    settling_s: float = 0.0

    @property
    def label(self) -> str:
        """The converters in words."""
        several = f"{self.converters} x " if self.converters > 1 else ""
        settle = f" + {self.settling_s * 1e6:g} us" if self.settling_s else ""
        return f"{several}{self.bits} bit at {self.rate_hz / 1e3:g} kS/s{settle}"

    def seconds(self, conversions: int) -> float:
        """Time of so many conversions, seconds."""
        each = -(-conversions // self.converters)
        return each * (1 / self.rate_hz + self.settling_s)


def read_adc(text: object) -> Adc:
    """One converter that a text such as "10bit@200kS/s" states; SettingsError for other forms."""
    found = _ADC.fullmatch(text) if isinstance(text, str) and len(text) <= 40 else None
    if found is None:
        raise SettingsError(f"{shown(text)}: expected bits and conversions a second, as {FORM}")
    bits = int(found[1])
    if not 4 <= bits <= 24:
        raise SettingsError(f"{shown(text)}: {bits} bits; allowed: 4..24")
    rate_hz = quantity(found[2], SAMPLES, "200kS/s", 1.0, 1e10)
    return Adc(bits, rate_hz)
