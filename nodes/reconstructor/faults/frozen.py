"""Detection of a board that hangs: all of its measurements repeat exactly."""

from __future__ import annotations

import numpy as np

from sparseskin.messages.quantised import step_of
from sparseskin.nodes.numerics.arrays import Floats

FRAMES, MEASUREMENTS = 4, 60
"""Least number of frames that repeat exactly, and of the measurements in them, after which a board
hangs. Chosen: noise of half a step of the quantiser repeats 60 of them in one of 10^18 cases."""
LEAST_NOISE = 0.5
"""Least deviation of the stated noise, in steps of the quantiser, at which measurements cannot
repeat by themselves."""


class FrozenWatch:
    """Finds frames that repeat those before bit by bit, on a skin that states a noise.

    A frame is compared with the last one of its own row subset. It makes no difference whether
    anything touches the skin.

    Parameters
    ----------
    sigma : float
        Least standard deviation of a taxel's noise, in the unit of the forces; 0 where it is not
        stated: nothing is frozen then.

    Attributes
    ----------
    frozen : bool
        True from the 4th repeated frame on, until one differs.
    """

    def __init__(self, sigma: float) -> None:
        self._sigma = sigma
        self._last: dict[str, Floats] = {}
        self._n_equal = 0
        self.frozen = False

    def update(self, subset: str, y: Floats) -> bool:
        """Process the measurements of a row subset, float32 (m,); return True if `frozen` changes.

        `subset` is the fingerprint of its Phi.
        """
        if not self._sigma:
            return False
        last = self._last.get(subset)
        repeats = last is not None and np.array_equal(last, y)
        if not repeats:
            self._last[subset] = np.array(y, dtype=np.float32)
        self._n_equal = (
            self._n_equal + 1 if repeats and self._sigma > LEAST_NOISE * step_of(y) else 0
        )
        before = self.frozen
        self.frozen = self._n_equal >= max(FRAMES, MEASUREMENTS / y.size)
        return self.frozen != before
