"""Solvers that iterate on the image itself: what they have in common."""

from __future__ import annotations

import math
from abc import abstractmethod

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.parameters import MAX_ITERATIONS, whole_number
from sparseskin.nodes.reconstructor.projection import make_projection
from sparseskin.nodes.reconstructor.solver import Mask, Solver


class ImageSolver(Solver):
    """A constant number of iterations on an image, from the image of the last frame.

    A subclass says what a frame begins with and what an iteration does.

    Parameters
    ----------
    phi, basis, mask
        As in `Solver`.
    iterations : int
        1..1000.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.
    """

    #: The name it is registered by, for messages.
    name: str

    def __init__(
        self, phi: Phi, basis: Basis, mask: Mask | None = None, *, iterations: int
    ) -> None:
        super().__init__(phi, basis, mask)
        self.iterations = whole_number(self.name, "iterations", iterations, 1, MAX_ITERATIONS)
        self.n_steps = self.iterations
        self._projection = make_projection(phi)
        self._step_size = np.float32(self._projection.step_size)
        n, shape = phi.n, self.mask.shape
        self._cell_of_place = self.taxels[self._projection.order]
        self._place_of_cell = np.full(self.mask.size, n, dtype=np.intp)
        self._place_of_cell[self._cell_of_place] = np.arange(n)
        self._inside: Floats = self.mask.astype(np.float32)
        self._image = np.zeros(shape, dtype=np.float32)
        self._gradient = np.zeros(shape, dtype=np.float32)
        self._places = np.zeros((1, n), dtype=np.float32)
        self._back_and_zero = np.zeros(n + 1, dtype=np.float32)
        self._y = np.zeros(self._projection.n_rows, dtype=np.float32)
        self._r = np.zeros((1, self._projection.n_rows), dtype=np.float32)
        self._done = self.iterations  # no frame is begun

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        """Begin a frame; parameters and Raises as in `solve`."""
        self._projection.rows_of(self._checked_y(y), self._y)
        if warm is not None:
            np.multiply(self._checked_warm(warm), self._inside, self._image)
        self._begin()
        self._done = 0

    def step(self) -> None:
        """Do one iteration of the frame that was begun.

        Raises
        ------
        SolverError
            If the frame has had all its iterations, or none was begun.
        """
        if self._done == self.iterations:
            raise SolverError(f"{self.name}: no step is left of the frame's {self.iterations}")
        self._iterate()
        self._done += 1

    def finish(self) -> Floats:
        """End the frame and return its estimate, as `solve` does."""
        self._done = self.iterations
        forces = np.maximum(self._estimate(), 0)
        np.multiply(forces, self._inside, forces)
        if not np.isfinite(forces).all():
            self.reset()
            raise SolverError(f"{self.name}: the iteration diverged: is phi.lipschitz too small?")
        return forces

    def reset(self) -> None:
        """Forget all earlier frames: the next one starts from 0."""
        self._image.fill(0)

    @abstractmethod
    def _begin(self) -> None:
        """Get ready for a frame, from `_image`."""

    @abstractmethod
    def _iterate(self) -> None:
        """Do one iteration; the estimate is left in `_image`."""

    def _estimate(self) -> Floats:
        """What a frame ends with, float32 (n_rows, n_cols)."""
        return self._image

    def _descend(self, image: Floats) -> float:
        """Write Phi^T (y - Phi image) / L to `_gradient`; the root mean square of y - Phi image.

        Cells without a taxel get 0.
        """
        image.reshape(-1).take(self._cell_of_place, None, self._places[0], "clip")
        self._projection.forward(self._places, self._r)
        np.subtract(self._y, self._r[0], self._r[0])
        self._projection.adjoint(self._r[0], self._back_and_zero[:-1])
        flat = self._gradient.reshape(-1)
        self._back_and_zero.take(self._place_of_cell, None, flat, "clip")
        return math.sqrt(float(np.dot(self._r[0], self._r[0])) / self.phi.m)
