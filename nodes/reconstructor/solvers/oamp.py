"""Orthogonal approximate message passing with randomly shifted Haar."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.numerics.programs import run
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.bases.shifted_haar import SHIFTS, ShiftedHaar

from .base import whole_number
from .proximal import ImageSolver

#: Soft threshold, in standard deviations of the error of the linear step.
THRESHOLD = 1.5
#: Damping of an iteration: without it, blocks of 32 taxels and M <= N/3 diverge.
DAMPING = 0.7
#: Upper limit of the mean derivative d: the factor 1 / (1 - d) must stay bounded.
MAX_DERIVATIVE = 0.5
#: The iteration is taken to diverge where the RMS residual is this many times its least so far.
DIVERGING = 1.5
#: Number of shifts drawn in advance; a prime, so that their sequence is in step with nothing.
N_DRAWN = 4093


class OampSolver(ImageSolver):
    """Alternates a linear step that is unbiased with a denoiser that is divergence-free.

    r = x + N/M Phi^T (y - Phi x), whose error is taken for normal noise of variance
    tau^2 = N/M mean (y - Phi x)^2; x = (eta(r) - d r) / (1 - d), damped, eta soft thresholding
    by 1.5 tau of three levels of Haar under a random shift, d the mean of its derivative. The
    noise level is thus estimated in each iteration. The estimate is max(0, eta(r)). A frame
    starts from the estimate of the last one.

    With few measurements in small blocks its assumptions do not hold. Where it begins to
    diverge, the rest of the frame is plain proximal steps of length 1 from the best estimate.

    Parameters
    ----------
    phi, mask, iterations
        As in `ImageSolver`.
    basis : Basis
        Gives the size of the grid; the solver has its own Haar.
    seed : int
        Seed of the shifts, at least 0.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.

    Notes
    -----
    Source: Ma, Ping, "Orthogonal AMP", IEEE Access 5, 2017; Metzler, Maleki, Baraniuk, "From
    denoising to compressed sensing", IEEE Trans. Information Theory 62(9), 2016, for a denoiser
    in it.
    """

    name = "oamp"

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int = 20,
        seed: int = 0,
    ) -> None:
        super().__init__(phi, basis, mask, iterations=iterations)
        whole_number(self.name, "seed", seed, 0, 2**32 - 1)
        n = phi.n
        self._haar = ShiftedHaar(self.mask.shape, self._place_of_cell.reshape(self.mask.shape), n)
        rng = np.random.default_rng(seed)
        self._shifts: list[int] = rng.integers(len(SHIFTS), size=N_DRAWN).tolist()
        self._next_shift = 0
        self._canvas, self._c, scratch = np.zeros((3, self._haar.size), dtype=np.float32)
        self._analysis = self._haar.analysis(self._canvas, self._c, scratch)
        self._synthesis = self._haar.synthesis(self._c, self._canvas, scratch)
        self._width = np.sqrt(self._haar.weights2)
        self._gain = np.float32(phi.n / phi.m / self._projection.step_size)
        self._x, self._best = np.zeros((2, *self.mask.shape), dtype=np.float32)
        self._places_and_zero = np.zeros(n + 1, dtype=np.float32)

    def reset(self) -> None:
        super().reset()
        self._next_shift = 0

    def _begin(self) -> None:
        np.copyto(self._x, self._image)
        np.copyto(self._best, self._image)
        self._least = math.inf
        self._diverging = False

    def _iterate(self) -> None:
        rms = self._descend(self._x)
        if rms > DIVERGING * self._least:
            self._diverging = True
            np.copyto(self._x, self._best)
            rms = self._descend(self._x)
        elif rms < self._least:
            self._least = rms
            np.copyto(self._best, self._image)
        r = self._gradient
        tau = math.sqrt(self.phi.n / self.phi.m) * rms
        if self._diverging:
            tau *= self.phi.m / self.phi.n
        else:
            np.multiply(r, self._gain, r)
        np.add(r, self._x, r)
        derivative = min(self._shrink(r, THRESHOLD * tau), MAX_DERIVATIVE)
        np.maximum(self._image, 0, out=self._image)
        if self._diverging:
            np.copyto(self._x, self._image)
            return
        free = (self._image - np.float32(derivative) * r) * np.float32(1 / (1 - derivative))
        np.multiply(free, self._inside, free)
        self._x += np.float32(DAMPING) * (free - self._x)

    def _shrink(self, r: Floats, threshold: float) -> float:
        """Write eta(r) to `_image`; return the mean of its derivative."""
        to_canvas, from_canvas = self._haar.tables(self._shifts[self._next_shift])
        self._next_shift = (self._next_shift + 1) % N_DRAWN
        r.reshape(-1).take(self._cell_of_place, None, self._places_and_zero[:-1], "clip")
        self._places_and_zero.take(to_canvas, None, self._canvas, "clip")
        run(self._analysis)
        limit = np.float32(threshold + 1e-30) / self._width
        derivative = np.count_nonzero(np.abs(self._c) > limit) / self.phi.n
        self._c -= np.clip(self._c, -limit, limit)
        self._c *= self._haar.weights2
        run(self._synthesis)
        self._canvas.take(from_canvas, None, self._back_and_zero[:-1], "clip")
        self._back_and_zero.take(self._place_of_cell, None, self._image.reshape(-1), "clip")
        return derivative
