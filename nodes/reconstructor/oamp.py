"""Orthogonal approximate message passing with randomly shifted Haar."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.calls import Floats, run
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.image_solver import ImageSolver
from sparseskin.nodes.reconstructor.parameters import whole_number
from sparseskin.nodes.reconstructor.shifted_haar import SHIFTS, ShiftedHaar
from sparseskin.nodes.reconstructor.solver import Mask

#: Threshold in deviations of what the linear step leaves.
THRESHOLD = 1.5
#: Part of an iteration's change that is done: with blocks of 32 taxels and M <= N/3 the whole of
#: it diverges.
DAMPING = 0.7
#: A denoiser that passes nearly everything would be extrapolated without bound.
MOST_PASSED = 0.5
#: Where the misfit has grown by this factor over its least, the iteration is about to diverge.
GROWN = 1.5
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
    phi, mask
        As in `Solver`.
    basis : Basis
        Gives the size of the grid; the solver has its own Haar.
    iterations : int
        1..1000.
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
        size = self._haar.size
        self._canvas, self._c, scratch = (np.zeros(size, dtype=np.float32) for _ in range(3))
        self._analysis = self._haar.analysis(self._canvas, self._c, scratch)
        self._synthesis = self._haar.synthesis(self._c, self._canvas, scratch)
        self._width = np.sqrt(self._haar.weights2)
        self._gain = np.float32(phi.n / phi.m / self._projection.step_size)
        self._x: Floats = np.zeros_like(self._image)
        self._best: Floats = np.zeros_like(self._image)
        self._places_and_zero = np.zeros(n + 1, dtype=np.float32)

    def reset(self) -> None:
        """Forget all earlier frames: the next one starts from 0."""
        super().reset()
        self._next_shift = 0

    def _begin(self) -> None:
        np.copyto(self._x, self._image)
        np.copyto(self._best, self._image)
        self._least = math.inf
        self._careful = False

    def _iterate(self) -> None:
        misfit = self._descend(self._x)
        if misfit > GROWN * self._least:
            self._careful = True
            np.copyto(self._x, self._best)
            misfit = self._descend(self._x)
        elif misfit < self._least:
            self._least = misfit
            np.copyto(self._best, self._image)
        r = self._gradient
        tau = math.sqrt(self.phi.n / self.phi.m) * misfit
        if self._careful:
            tau *= self.phi.m / self.phi.n
        else:
            np.multiply(r, self._gain, r)
        np.add(r, self._x, r)
        passed = min(self._shrink(r, THRESHOLD * tau), MOST_PASSED)
        np.maximum(self._image, 0, out=self._image)
        if self._careful:
            np.copyto(self._x, self._image)
            return
        free = (self._image - np.float32(passed) * r) * np.float32(1 / (1 - passed))
        np.multiply(free, self._inside, free)
        self._x += np.float32(DAMPING) * (free - self._x)

    def _shrink(self, r: Floats, threshold: float) -> float:
        """Write eta(r) to `_image`; the mean of its derivative."""
        to_canvas, from_canvas = self._haar.tables(self._shifts[self._next_shift])
        self._next_shift = (self._next_shift + 1) % N_DRAWN
        r.reshape(-1).take(self._cell_of_place, None, self._places_and_zero[:-1], "clip")
        self._places_and_zero.take(to_canvas, None, self._canvas, "clip")
        run(self._analysis)
        limit = np.float32(threshold + 1e-30) / self._width
        passed = np.count_nonzero(np.abs(self._c) > limit) / self.phi.n
        self._c -= np.clip(self._c, -limit, limit)
        self._c *= self._haar.weights2
        run(self._synthesis)
        self._canvas.take(from_canvas, None, self._back_and_zero[:-1], "clip")
        self._back_and_zero.take(self._place_of_cell, None, self._image.reshape(-1), "clip")
        return passed
