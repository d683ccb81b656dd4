"""The bias of measurements whose noise is clipped at 0."""

from __future__ import annotations

import math

from sparseskin.nodes.numerics.arrays import TINY

from .row_subset import RowSubset
from .tuning import SkinTuning
from .vectors import Settled

DUST = 1e-6
"""Squared length of Phi 1 a taxel up to which it is 0 but for rounding: no row of the subset sees
a bias. Derived: float32 leaves 1e-12, one row of +1 has 32 / N, above 1e-6 up to 3e7 taxels."""
NEGLIGIBLE_BIAS = 1e-3
"""Bias that counts as 0, in deviations of the noise: 1 / b could overflow float32."""


class Bias:
    """Mean reading b of an untouched taxel.

    Attributes
    ----------
    value : float
        b, as known so far.
    """

    def __init__(self, tuning: SkinTuning) -> None:
        self._tuning = tuning
        self.forget()

    def forget(self) -> None:
        """Begin anew, as if no frame had been measured."""
        self.value = 0.0
        self._n_frames = 0.0

    @property
    def is_known(self) -> bool:
        """True once it no longer passes for forces on all taxels."""
        return self._n_frames > self._tuning.bias_known + 0.5

    def follow(
        self,
        settled: Settled,
        subset: RowSubset,
        n: int,
        noise2: float,
        repeated: float,
    ) -> None:
        """Update the bias: by the residual along Phi 1, and by the n taxels that are not pressed.

        noise2 is the noise variance of an untouched taxel, `repeated` the part of the measurements
        that are no others.
        """
        tuning = self._tuning
        noise_sd = math.sqrt(noise2)
        along = 0.0
        if subset.ones_energy > DUST * n:
            along = settled.along_ones / (subset.ones_energy + TINY)
        excess = along + settled.unpressed / n
        step = min(max(excess, -noise_sd / 2), noise_sd / 2)

        n_frames = self._n_frames + 1
        rate = max(
            tuning.bias_begins / (n_frames + tuning.bias_begins), tuning.bias_rate
        )
        bias = min(max(self.value + rate * step, 0.0), tuning.most_bias * noise_sd)

        self._n_frames = n_frames - repeated
        bias = (1 - repeated) * bias + repeated * self.value
        self.value = bias
        if bias < NEGLIGIBLE_BIAS * noise_sd:
            self.value = 0.0
