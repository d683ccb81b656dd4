"""The noise of a taxel: normal, largest at mid-range, clipped to the range.

A taxel under the force f in [0, f_max] reads clip(f + sigma(f) z, 0, f_max) with z ~ N(0, 1) and

    sigma(f) = sigma_mid + (sigma_end - sigma_mid) |f - f_max / 2| / (f_max / 2).

Source: paper, section V-B: zero-mean normal noise of sigma 0.0628 N at mid-range, smaller towards
both ends, then clipped. The shape of the taper and its end value are not in the paper: see
`PAPER_SIGMA_END_N`.
"""

import math
from dataclasses import KW_ONLY, dataclass

import numpy as np

from sparseskin.messages.ranges import is_real
from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.numerics.arrays import Floats

PAPER_SIGMA_MID_N = 0.0628
"""Standard deviation at f_max / 2, newtons. Source: paper, section V-B."""
PAPER_SIGMA_END_N = 0.0141
"""Standard deviation at 0 and at f_max, newtons. Fitted: the noisy PSNR of an untouched skin then
reaches at most 48.5 to 49.1 dB, as the paper's tables report."""

CLIPPED = 0.5 - 0.5 / math.pi
CLIPPED_BELOW = 1.6
"""Variance of max(0, z), z ~ N(0, 1): 1/2 - 1/(2 pi) = 0.3408; mean of z up to which it grows to 1.
Derived: as a line, to 0.07."""


@dataclass(frozen=True)
class NoiseModel:
    """Zero-mean normal noise whose sigma depends on the force, clipped to [0, f_max].

    Clipping makes untouched taxels read sigma_end / sqrt(2 pi) = 0.4 sigma_end too high on average.

    Parameters
    ----------
    f_max : float
        Upper end of the range, in the unit of the forces, above 0.
    sigma_mid, sigma_end : float
        Standard deviation at mid-range and at both ends, in the same unit, in [0, f_max].
    clips : bool
        True if readings are clipped at 0; those of `apply` always are.
    of_touched : bool
        True if taxels that nothing touches are not read: `variance` is 0 there.

    Raises
    ------
    SettingsError
        If a parameter is not finite or outside its range.
    """

    f_max: float = PAPER_F_MAX_N
    sigma_mid: float = PAPER_SIGMA_MID_N
    sigma_end: float = PAPER_SIGMA_END_N
    _: KW_ONLY
    clips: bool = True
    of_touched: bool = False

    def __post_init__(self) -> None:
        if not (is_real(self.f_max, 0.0) and self.f_max > 0.0):
            raise SettingsError(
                f"noise model: f_max is {self.f_max!r}; allowed is a finite number "
                "above 0"
            )

        # Noise as large as the range would leave nothing to measure.
        allowed = f"0 to f_max = {self.f_max!r}, both included"
        for name in ("sigma_mid", "sigma_end"):
            sigma = getattr(self, name)
            if not is_real(sigma, 0.0, self.f_max):
                raise SettingsError(
                    f"noise model: {name} is {sigma!r}; allowed is {allowed}"
                )

    @classmethod
    def for_range(cls, f_max: float, times: float = 1.0) -> "NoiseModel":
        """Return `times` the paper's noise, scaled to another range; raises as the class does."""
        scale = f_max / PAPER_F_MAX_N
        sigma_mid = times * (scale * PAPER_SIGMA_MID_N)
        sigma_end = times * (scale * PAPER_SIGMA_END_N)
        return cls(f_max, sigma_mid, sigma_end)

    def sigma(self, forces: Floats) -> Floats:
        """Standard deviation of the noise before clipping, in the unit and shape of the true
        forces, float32 in [0, f_max].
        """
        # In float32 and in place: it is part of `apply`.
        half = np.float32(self.f_max / 2)
        slope = np.float32((self.sigma_end - self.sigma_mid) / (self.f_max / 2))
        sigma: Floats = np.abs(forces - half, dtype=np.float32)
        sigma *= slope
        sigma += np.float32(self.sigma_mid)
        return sigma

    def variance(self, forces: Floats) -> Floats:
        """Return the variance of the readings of some forces.

        Arguments and result as in `sigma`, squared.
        """
        # Distance from mid-range, 1 at both ends; estimates may lie beyond the range.
        distance = np.abs(2 / self.f_max * forces - 1).clip(None, 1)
        sigma = self.sigma_mid + (self.sigma_end - self.sigma_mid) * distance
        variance: Floats = sigma * sigma

        # An untouched taxel loses the half of its noise that is below 0.
        if self.clips and self.sigma_end:
            slope = (1 - CLIPPED) / CLIPPED_BELOW / self.sigma_end
            clipped_part = (CLIPPED + slope * forces).clip(None, 1)
            variance = variance * clipped_part
        if self.of_touched:
            variance = variance * (forces > 0)
        return variance

    def apply(self, truth: Floats, rng: np.random.Generator) -> Floats:
        """Readings of a noisy skin, a fresh array in [0, f_max], of true forces in that range,
        float32 of any shape. The same state of `rng` gives the same readings.
        """
        # In place: a large skin has a million taxels.
        taxels = rng.standard_normal(truth.shape, dtype=np.float32)
        taxels *= self.sigma(truth)
        taxels += truth
        np.clip(taxels, np.float32(0.0), np.float32(self.f_max), out=taxels)
        return taxels
