"""The noise of a taxel: normal, largest at mid-range, clipped to the range."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.sensor.source import Forces

PAPER_F_MAX_N = 2.5
PAPER_SIGMA_MID_N = 0.0628
# How far sigma tapers the paper does not say. This value makes the noisy PSNR of an untouched
# skin top out near 49 dB, as its tables report.
PAPER_SIGMA_END_N = 0.0141


@dataclass(frozen=True)
class NoiseModel:
    """Zero-mean normal noise whose sigma depends on the force; readings stay in [0, f_max].

    Sigma falls linearly from `sigma_mid` at f_max / 2 to `sigma_end` at 0 and at f_max. Clipping
    at 0 makes untouched taxels read 0.4 `sigma_end` too high on average.

    Attributes
    ----------
    f_max : float
        Upper end of the range, in the unit of the forces, above 0.
    sigma_mid, sigma_end : float
        Standard deviation at mid-range and at both ends, in the same unit, in [0, f_max].

    Raises
    ------
    SettingsError
        A parameter is not finite or outside its range.

    Notes
    -----
    Source: paper, section V-B.
    """

    f_max: float = PAPER_F_MAX_N
    sigma_mid: float = PAPER_SIGMA_MID_N
    sigma_end: float = PAPER_SIGMA_END_N

    def __post_init__(self) -> None:
        if not (math.isfinite(self.f_max) and self.f_max > 0.0):
            raise SettingsError(
                f"noise model: f_max is {self.f_max!r}; allowed is a finite number above 0"
            )
        for name in ("sigma_mid", "sigma_end"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0.0 <= value <= self.f_max):
                raise SettingsError(
                    f"noise model: {name} is {value!r}; "
                    f"allowed is 0 to f_max = {self.f_max!r}, both included"
                )

    @classmethod
    def for_range(cls, f_max: float) -> NoiseModel:
        """The paper's noise, scaled to a sensor of another range.

        Parameters
        ----------
        f_max : float
            Upper end of the range, in the unit of the forces, finite and above 0.

        Raises
        ------
        SettingsError
            `f_max` is not finite or not above 0.
        """
        scale = f_max / PAPER_F_MAX_N
        return cls(f_max, scale * PAPER_SIGMA_MID_N, scale * PAPER_SIGMA_END_N)

    def sigma(self, forces: Forces) -> Forces:
        """Standard deviation of the noise on each force, before clipping.

        Parameters
        ----------
        forces : ndarray of float32, any shape
            True forces in [0, f_max].

        Returns
        -------
        ndarray of float32, same shape
            Sigma in the unit of the forces.
        """
        half = np.float32(self.f_max / 2)
        slope = np.float32((self.sigma_end - self.sigma_mid) / (self.f_max / 2))
        sigma: Forces = np.abs(forces - half, dtype=np.float32)
        sigma *= slope
        sigma += np.float32(self.sigma_mid)
        return sigma

    def apply(self, truth: Forces, rng: np.random.Generator) -> Forces:
        """Readings of a noisy skin.

        Parameters
        ----------
        truth : ndarray of float32, any shape
            True forces in [0, f_max]; not modified.
        rng : numpy.random.Generator
            Where the noise comes from; the same state gives the same readings.

        Returns
        -------
        ndarray of float32, same shape
            A fresh array in [0, f_max].
        """
        taxels = rng.standard_normal(truth.shape, dtype=np.float32)
        taxels *= self.sigma(truth)
        taxels += truth
        np.clip(taxels, np.float32(0.0), np.float32(self.f_max), out=taxels)
        return taxels
