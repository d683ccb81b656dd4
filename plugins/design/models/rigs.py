"""Skins that were built, and what the models of this study predict for them."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from .adc import read_adc
from .buses import read_bus
from .units import TIME, quantity

WITHIN = 2.0
"""Factor within which a prediction is to be."""


@dataclass(frozen=True)
class Rig:
    """A skin that was built, of `rigs.toml`.

    Attributes
    ----------
    name, reads : str
        The skin, and what it reads.
    published_hz : float
        Rate that is published, or measured by its users.
    facts, reason : str
        Where each number comes from; why prediction and rate differ, "" where that is not stated.
    conversions, n_bytes : int
        Conversions of a frame, and its bytes on the bus.
    adc, settling, bus : str
        As of `sparseskin design`; "" for a converter or bus that is left out.
    """

    name: str
    reads: str
    published_hz: float
    facts: str
    reason: str = ""
    conversions: int = 0
    n_bytes: int = 0
    adc: str = ""
    settling: str = "0us"
    bus: str = ""

    @property
    def stage_hz(self) -> dict[str, float]:
        """Frames a second of each stage that is modelled."""
        found = {}
        if self.adc:
            settling_s = quantity(self.settling, TIME, "5us", 0.0, 1.0)
            found["ADC"] = 1 / read_adc(self.adc, 1, settling_s).seconds(self.conversions)
        if self.bus:
            found["bus"] = 1 / read_bus(self.bus).seconds(self.n_bytes)
        return found

    @property
    def limit(self) -> str:
        """The slowest stage."""
        return min(self.stage_hz, key=self.stage_hz.__getitem__)

    @property
    def predicted_hz(self) -> float:
        """Frames a second that the models predict."""
        return self.stage_hz[self.limit]

    @property
    def ratio(self) -> float:
        """Predicted over published rate."""
        return self.predicted_hz / self.published_hz

    @property
    def is_within(self) -> bool:
        """True if the prediction is within a factor 2."""
        return 1 / WITHIN <= self.ratio <= WITHIN


RIGS = tuple(
    Rig(**rig)
    for rig in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))["rig"]
)
"""Rigs, in the order of the table."""
