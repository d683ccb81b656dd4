"""The bias of readings clipped at 0: estimated from the measurements, and corrected."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Floats
from sparseskin.nodes.reconstructor.solvers.projection import Projection

from .tuning import TUNING, SkinTuning

#: Squared length of Phi 1 a taxel up to which it is 0 but for rounding: no row of the subset sees
#: a bias. Derived: float32 leaves 1e-12, one row of +1 has 32 / N, above 1e-6 up to 3e7 taxels.
DUST = 1e-6


class ClipBias:
    """The mean reading of an untouched taxel, whose noise is clipped at 0.

    The bias is one number b for the whole skin. b Phi 1 is subtracted from the measurements, so
    that an untouched taxel is reconstructed as 0. A touched taxel has no bias: a force whose
    readings have the mean b + u is u + b (1 - exp(-u / b)), to within 0.03 b (`add_back`).

    The estimate follows the residual along Phi 1 and, as a bias looks like a force on most taxels,
    the median of the taxels. On a skin without bias it ends at b = 0.

    Attributes
    ----------
    b : float
        The estimate, newtons, at least 0.
    ones : ndarray of float32, shape (n_rows,)
        Phi 1 as a vector of rows, of the current row subset.
    energy : float
        Its squared length; 0 where no row sees a bias.
    """

    def __init__(self, projection: Projection, n: int, tuning: SkinTuning = TUNING) -> None:
        self._t = tuning
        self._projection = projection
        self._n = n
        self._known: dict[int, tuple[Floats, float]] = {}
        self.use(0)
        self._b = np.zeros((), dtype=np.float32)
        self._scaled = np.zeros_like(self.ones)
        self.reset()

    def use(self, subset: int) -> None:
        """Expect measurements of the row subset of this number, which the projection now is of."""
        if subset not in self._known:
            rows = np.zeros((1, self._projection.n_rows), dtype=np.float32)
            self._projection.forward(np.ones((1, self._n), dtype=np.float32), rows)
            energy = float(np.dot(rows[0], rows[0]))
            self._known[subset] = rows[0], energy if energy > DUST * self._n else 0.0
        self.ones, self.energy = self._known[subset]

    def reset(self) -> None:
        """Forget all frames."""
        self.b = 0.0
        self._n_frames = 0
        self._least_s2 = math.inf

    def subtract(self, y_rows: Floats) -> None:
        """Subtract the bias from measurements in place, a vector of rows."""
        if self.b:
            self._b[()] = self.b
            np.multiply(self.ones, self._b, self._scaled)
            np.subtract(y_rows, self._scaled, y_rows)

    def update(
        self, left: float, x: Floats, s2: float, most: float = math.inf, again: bool = False
    ) -> None:
        """Process a reconstructed frame x without the bias, float32 (n,), newtons.

        `left` is the product of Phi 1 with the residual, s2 the variance of a measurement's noise,
        and `most` another bound of it; `again` as in `NoiseLevel`: the least noise is forgotten.
        """
        if again:
            self._n_frames, self._least_s2 = 0, math.inf
        self._n_frames += 1
        more = left / self.energy if self.energy else 0.0
        first = max(self._t.median_first, self._t.median_rounds * len(self._known))
        if self._n_frames <= first or self._n_frames % self._t.median_every == 0:
            more += float(np.median(x))
        self._least_s2 = min(self._t.bias_forgotten * self._least_s2, s2)
        noise = math.sqrt(min(self._least_s2, most))
        more = min(max(more, -noise / 2), noise / 2)
        begins = self._t.bias_begins
        rate = max(self._t.bias_slowest, begins / (self._n_frames + begins))
        self.b = min(max(self.b + rate * more, 0.0), self._t.bias_largest * noise)
        if self.b < TINY:  # its reciprocal could overflow float32
            self.b = 0.0

    def add_back(self, forces: Floats) -> None:
        """Convert means above b to forces, in place, float32 of any shape."""
        if self.b:
            with np.errstate(over="ignore"):  # exp(-inf) is 0
                share = forces * np.float32(-1 / self.b)
            np.exp(share, share)
            np.subtract(np.float32(1), share, share)
            np.multiply(share, np.float32(self.b), share)
            np.add(forces, share, forces)
