"""A solver with a scripted estimate of its own error."""

from typing import Any

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.solvers.base import Solver

DOUBTING = "doubting:DoubtingSolver"
ERROR = 0.25


class DoubtingSolver(Solver):
    """0.5 in every other row, error 0.25; doubts the first `n_doubted` of a `period`."""

    name = "doubting"

    def __init__(
        self, phi: Any, basis: Any, mask: Any, n_doubted: int = 0, period: int = 1
    ):
        super().__init__(phi, basis, mask)
        self._n_doubted, self._period = n_doubted, period
        self._n_frames = 0

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        self._checked_y(y)
        self._steps_left = self.n_steps

    def step(self) -> None:
        self._count_step()

    def finish(self) -> Floats:
        self.error = ERROR
        self.trusted = self._n_frames % self._period >= self._n_doubted
        self._n_frames += 1
        forces = np.zeros(self.mask.shape, np.float32)
        forces[::2] = 0.5
        return self._final_forces(forces)

    def reset(self) -> None:
        self._n_frames = 0
