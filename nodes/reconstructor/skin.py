"""The default solver: random shifts of Haar, and what the last frame knows."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sparseskin.nodes.compressor.calls import Floats, run
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.compressor.sbhe import SbhePhi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.fast import MAX_PLACES, use_compiled
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.clip_bias import ClipBias
from sparseskin.nodes.reconstructor.kalman_weight import KalmanWeight
from sparseskin.nodes.reconstructor.neighbours import Neighbours
from sparseskin.nodes.reconstructor.noise_level import NoiseLevel
from sparseskin.nodes.reconstructor.parameters import MAX_ITERATIONS, whole_number
from sparseskin.nodes.reconstructor.prediction import Prediction
from sparseskin.nodes.reconstructor.projection import make_projection
from sparseskin.nodes.reconstructor.row_memory import RowMemory
from sparseskin.nodes.reconstructor.shifted_haar import SHIFTS, TILE, ShiftedHaar
from sparseskin.nodes.reconstructor.solver import Mask, Solver

#: Threshold, in root mean squares of what is left of the measurements.
THRESHOLD = 1.4
#: The least threshold, in deviations of the noise that a filtered frame has.
LEAST_THRESHOLD = 0.5
#: ... and in root mean squares of the misfit that a frame begins with. With a threshold that
#: falls as the misfit does, nothing would hold against an estimate that explains the
#: measurements and is wrong.
HELD_THRESHOLD = 0.8
#: ... which is less where rows rotate: the next frame's rows speak against it.
HELD_ROTATING = 0.3
#: The threshold of a frame that starts from nothing, in deviations of what its first gradient
#: step holds of the others' forces. With few measurements `THRESHOLD` would be far above that,
#: and a contact would not come up at all.
COLD_THRESHOLD = 2.4
#: Frames after a jump that are measured anew as the jump itself is, with all iterations: what it
#: left wrong where no measurement looks would be believed otherwise.
SETTLING = 2
#: Part of the noise that an estimate should leave unexplained: at most, and in M / N. Where it
#: left less, noise was restored as force, and the threshold rises: by which power of what is
#: missing, up to how many times, and how fast that is forgotten.
LEFT, LEFT_BY_RATIO = 0.65, 2.0
CAUTION, MOST_CAUTION, FORGETTING = 0.3, 1.5, 0.9
#: Where still less is left, it is the noise level that is wrong: at few frames a second, motion.
DOUBTED = 0.1
MOMENTUM = 0.7
#: The estimate is the mean of so many last iterates, each with its own shift.
AVERAGED = 3
#: Misfit, in noise variances, beyond which more iterations are done, and how many a variance.
SURPRISE, PER_SURPRISE = 1.05, 20.0
N_DRAWN = 4093
TINY = 1e-30


class SkinSolver(Solver):
    """Restores frames of a skin by all that is known of them; nothing has to be tuned.

    1. Noise cut off at 0 biases untouched taxels: the bias is found and taken off
       (`ClipBias`).
    2. The last frame predicts this one, affinely moved (`Prediction`), x_p.
    3. The misfit e = y - Phi x_p and the noise level (`NoiseLevel`) weigh prediction against
       measurements as a Kalman filter does (`KalmanWeight`): y' = Phi x_p + K e, K = 1 where
       the scene has jumped.
    4. Iterations from x_p: r = y' - Phi z, u = z + Phi^T r, x = max(0, Psi_s g(Psi_s^T u)),
       z = x + 0.7 (x - x_before). Psi_s is three levels of Haar under a random shift s
       (`ShiftedHaar`), g(c) = c max(0, 1 - lambda^2 / c^2) the nonnegative garrote, lambda 1.4
       root mean squares of r, and not far below what it begins with. Few iterations where a
       frame brings no surprise, more where it does.
    5. The mean of the last iterates, and the bias given back to touched taxels.

    An estimate that leaves far less of the measurements unexplained than their noise has restored
    noise as force: the next frame's thresholds are then higher, up to 1.5 times.

    Where rows rotate, one solver serves all phases (`use`): the prediction carries over, so that
    what the others have read stays known, and noise, bias and weight are kept by phase. An
    estimate that explains one frame's rows and is wrong is spoken against by the next; and what
    the others have read is aimed at too, as long as the skin is still (`RowMemory`).

    Lengths of steps, noise and threshold come from the measurements: a skin of another range
    gets the same relative errors. The same measurements give the same bits on one machine: the
    shifts are drawn from a generator of its own, which `reset` starts anew.

    Parameters
    ----------
    phi, mask
        As in `Solver`. "sbhe" with blocks of 64 at most is several times faster than others.
    basis : Basis
        Gives the size of the grid; the solver has its own Haar.
    iterations : int, optional
        Iterations of a frame that brings no surprise, 1..1000. None: 3 at M = N/3 and N/4, 4 at
        N/8; fewer measurements take more.
    max_iterations : int
        Iterations of a frame that does, at most, 1..1000; never fewer than `iterations`.
    seed : int
        Seed of the shifts, at least 0.
    fast : str
        Whether compiled loops do the work, for "sbhe": "auto" (where numba is installed), "on"
        or "off". The forces are the same but for rounding: to within some 1e-5 N at M = N/3. With
        far fewer measurements the method depends on rounding, with numpy as well: measurements
        that differ by 1e-7 N make as large a difference there.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.

    Notes
    -----
    Source: a denoiser within the iteration: Metzler, Maleki, Baraniuk, "From denoising to
    compressed sensing", IEEE Trans. Information Theory 62(9), 2016. Those of the parts stand
    with them.
    """

    rotates = True
    #: The squares of larger ones, summed, could overflow float32.
    y_max = 1e14

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int | None = None,
        max_iterations: int = 16,
        seed: int = 0,
        fast: str = "auto",
    ) -> None:
        super().__init__(phi, basis, mask)
        if iterations is None:
            iterations = min(2 + round(phi.ratio / 4), MAX_ITERATIONS)
        self.iterations = whole_number("skin", "iterations", iterations, 1, MAX_ITERATIONS)
        most = whole_number("skin", "max_iterations", max_iterations, 1, MAX_ITERATIONS)
        self.max_iterations = max(most, self.iterations)
        whole_number("skin", "seed", seed, 0, 2**32 - 1)

        n = phi.n
        self._phases = {phi.fingerprint: 0}
        n_tiles = math.prod(-(-side // TILE) for side in self.mask.shape)
        compiled = use_compiled(fast) and type(phi) is SbhePhi and n_tiles * TILE**2 < MAX_PLACES
        self._projection = make_projection(phi, compiled)
        self._place_of_cell = np.full(self.mask.size, n, dtype=np.intp)
        self._place_of_cell[self.taxels[self._projection.order]] = np.arange(n)
        places = self._place_of_cell.reshape(self.mask.shape)
        self._haar = ShiftedHaar(self.mask.shape, places, n)
        neighbours = Neighbours(places, n)
        self._prediction = Prediction(self._projection, neighbours, n, phi.m)
        self._noise = NoiseLevel(phi.m)
        self._bias = ClipBias(self._projection, n)
        self._filter = KalmanWeight(self._projection.n_rows)
        self._memory: RowMemory | None = None
        if self._projection.has_whole:
            self._memory = RowMemory(self._projection, phi.m, self._prediction.whole)
        rng = np.random.default_rng(seed)
        self._shifts: list[int] = rng.integers(len(SHIFTS), size=N_DRAWN).tolist()

        def floats(size: int) -> Floats:
            return np.zeros(size, dtype=np.float32)

        n_rows = self._projection.n_rows
        # Vectors of taxels end with a 0, which cells without a taxel read.
        self._x_and_zero, self._u_and_zero = floats(n + 1), floats(n + 1)
        self._x, self._u = self._x_and_zero[:n], self._u_and_zero[:n]
        self._before, self._z, self._sum = floats(n), floats(n), floats(n)
        self._y, self._misfit = floats(n_rows), floats(n_rows)
        self._target, self._r = floats(n_rows), floats(n_rows)
        self._canvas = floats(self._haar.size)
        # An array of them: numpy compares with a single number three times as slowly.
        self._zeros = floats(n)
        self._lambda2 = np.zeros((), dtype=np.float32)
        self._momentum = np.array(MOMENTUM, dtype=np.float32)
        self._factor = np.zeros((), dtype=np.float32)
        self._shrink = self._haar.shrinking(self._canvas, self._lambda2)
        #: What `step` and `finish` do to the vectors: with numpy, or in compiled loops.
        self._iterate: Callable[[int, float, float, bool], None] = self._numpy_iteration
        self._forces_of: Callable[[Floats, float], Floats] = self._numpy_forces
        if compiled:
            self._compile(neighbours)
        self.n_steps = self.iterations
        self.reset()

    def _compile(self, neighbours: Neighbours) -> None:
        """Let compiled loops do what takes most of the time."""
        # Imported here: they need numba.
        from sparseskin.nodes.reconstructor import fast_skin as fast
        from sparseskin.nodes.reconstructor.fast_projection import CompiledProjection

        projection, m = self._projection, self.phi.m
        assert isinstance(projection, CompiledProjection)
        vectors = (self._x, self._z, self._r, self._target, self._sum, self._canvas)
        self._prediction = fast.CompiledPrediction(projection, neighbours, self.phi.n, m)
        self._memory = fast.CompiledRowMemory(projection, m, self._prediction.whole)
        self._iterate = fast.CompiledIteration(
            projection, self._haar, (*vectors, self._u_and_zero), m, MOMENTUM
        )
        self._forces_of = fast.compiled_forces(self._place_of_cell)

    def reset(self) -> None:
        """Forget all earlier frames: the next one starts from 0."""
        self._x.fill(0)
        self._noise.reset()
        self._bias.reset()
        self._filter.reset()
        if self._memory is not None:
            self._memory.forget()
        self._caution = 1.0
        self._last_phi = self.phi
        self._rotating = self._begun = False
        phase = self._phases[self.phi.fingerprint]
        self._noise.use(phase)
        self._filter.use(phase)
        self._next_shift = 0
        self._done = self.n_steps  # no frame is begun

    def use(self, phi: Phi) -> None:
        """Take measurements of this phase of rotating rows from the next frame on.

        Parameters
        ----------
        phi : Phi
            Of the same kind and size as the one that the solver was made for, and other rows.

        Raises
        ------
        SolverError
            If it is of another size.
        """
        if (phi.n, phi.m) != (self.phi.n, self.phi.m):
            raise SolverError(
                f"skin: phi {phi.fingerprint} is {phi.m} x {phi.n}; "
                f"allowed: {self.phi.m} x {self.phi.n}"
            )
        phase = self._phases.setdefault(phi.fingerprint, len(self._phases))
        self.phi = phi
        self._projection.use(phi)
        self._noise.use(phase)
        self._bias.use(phase)
        self._filter.use(phase)

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        """Begin a frame; parameters and Raises as in `solve`."""
        y = self._checked_y(y)
        if self._begun and self.phi is not self._last_phi:
            self._rotating = True
        self._begun, self._last_phi = True, self.phi
        if warm is not None:
            cells = self.taxels[self._projection.order]
            self._checked_warm(warm).reshape(-1).take(cells, None, self._x, "clip")
            np.maximum(self._x, 0, out=self._x)
        self._projection.rows_of(y, self._y)
        self._bias.take_off(self._y)
        if self._projection.has_whole:
            self._projection.weigh(None)
        e2 = self._prediction.predict(self._x, self._y, self._misfit, self._noise.s2) / self.phi.m
        self._noise.update(y, e2, self._prediction.failed)
        jumped, settling = self._noise.jumped, self._noise.since_jump <= SETTLING
        self._filter.update(self._misfit, self.phi.m, self._noise.s2, settling)
        weight = self._filter.weight

        noise = 0.0 if jumped else LEAST_THRESHOLD * math.sqrt(self._filter.noise * weight)
        held = (HELD_ROTATING if self._rotating else HELD_THRESHOLD) * math.sqrt(e2) * weight
        self._least = max(noise, held) * self._projection.step_size
        cold = COLD_THRESHOLD / math.sqrt(self.phi.ratio)
        if jumped:
            self._caution = 1.0
        threshold = min(THRESHOLD, cold) if jumped else THRESHOLD * self._caution
        self._threshold = threshold * self._projection.step_size
        more = PER_SURPRISE * max(0.0, self._filter.surprise - SURPRISE)
        more = self.max_iterations if settling else min(more, self.max_iterations)
        self.n_steps = min(self.max_iterations, self.iterations + int(more))
        if self._memory is not None and self._rotating:
            self._recall(self._memory)
        else:
            # y' = Phi x_p + K e
            self._factor[()] = 1 - weight
            np.multiply(self._misfit, self._factor, self._target)
            np.subtract(self._y, self._target, self._target)
        np.copyto(self._z, self._x)
        self._sum.fill(0)
        self._done = self._n_summed = 0

    def step(self) -> None:
        """Do one iteration of the frame that was begun.

        Raises
        ------
        SolverError
            If the frame has had all its iterations, or none was begun.
        """
        if self._done == self.n_steps:
            raise SolverError(f"skin: no step is left of the frame's {self.n_steps}")
        summed = self._done >= self.n_steps - AVERAGED
        shift = self._shifts[self._next_shift]
        self._iterate(shift, self._threshold, self._least, summed)
        self._next_shift = (self._next_shift + 1) % N_DRAWN
        self._done += 1
        self._n_summed += summed

    def _numpy_iteration(self, shift: int, threshold: float, least: float, summed: bool) -> None:
        """Do one iteration under a shift; thresholds in root mean squares of r and in newtons."""
        x, u, z, r = self._x, self._u, self._z, self._r
        self._projection.forward(z[None], r[None])
        np.subtract(self._target, r, r)
        threshold *= math.sqrt(float(np.dot(r, r)) / self.phi.m)
        self._lambda2[()] = max(threshold, least) ** 2 + TINY
        self._projection.adjoint(r, u)
        np.add(u, z, u)

        to_canvas, from_canvas = self._haar.tables(shift)
        self._u_and_zero.take(to_canvas, None, self._canvas, "clip")
        run(self._shrink)
        np.copyto(self._before, x)
        self._canvas.take(from_canvas, None, x, "clip")
        np.maximum(x, self._zeros, out=x)

        np.subtract(x, self._before, z)
        np.multiply(z, self._momentum, z)
        np.add(z, x, z)
        if summed:
            np.add(self._sum, x, self._sum)

    def finish(self) -> Floats:
        """End the frame and return its estimate, as `solve` does."""
        if self._n_summed:
            self._factor[()] = 1 / self._n_summed
            np.multiply(self._sum, self._factor, self._x)
        if not math.isfinite(float(np.dot(self._x, self._x))):
            self.reset()
            raise SolverError("skin: the iteration diverged: is phi.lipschitz too small?")
        if self._done:
            # y - Phi x is what the last iteration left, and what the weight kept from it.
            ones, kept = self._bias.ones, 1 - self._filter.weight
            left = float(np.dot(ones, self._r)) + kept * float(np.dot(ones, self._misfit))
            self._bias.update(left, self._x, self._noise.s2)
            unexplained, free = self._unexplained(), int(np.count_nonzero(self._x))
            self._watch_out(unexplained, free)
            if self._rotating:
                self._noise.limit(self._noise_of(unexplained, free))
        self._done = self.n_steps
        return self._forces_of(self._x_and_zero, self._bias.b).reshape(self.mask.shape)

    def _recall(self, memory: RowMemory) -> None:
        """Let the rows that earlier frames have read count, as far as they still hold."""
        # What settles after a jump would be held where it is still wrong.
        if self._noise.since_jump <= SETTLING:
            memory.forget()
        memory.recall(
            self._phases[self.phi.fingerprint],
            self._x if self._prediction.moved else None,
            *(self._y, self._filter.weight, self._noise.s2, self._filter.surprise),
            self._target,
        )
        # The mean square of r, which thresholds go by, is that of the rows that count.
        self._threshold *= math.sqrt(self.phi.m / memory.m_counted)

    def _unexplained(self) -> float:
        """Energy of what the frame leaves of its own measurements, had K been 1."""
        r = self._r
        if self._memory is not None and self._rotating:
            r = np.multiply(r, self._memory.read, self._target)
        return float(np.dot(r, r)) / self._filter.weight**2

    def _watch_out(self, unexplained: float, free: int) -> None:
        """Raise the threshold of the next frame where this one explains too much."""
        noise = self.phi.m * self._noise.s2
        if free > self.phi.m or unexplained < DOUBTED * noise:
            # As many free numbers explain everything, right or wrong: that says nothing.
            self._caution = max(1.0, FORGETTING * self._caution)
        elif unexplained > 0 and noise > 0:
            left = min(LEFT, LEFT_BY_RATIO / self.phi.ratio)
            caution = self._caution * (left * noise / unexplained) ** CAUTION
            self._caution = min(max(caution, 1.0), MOST_CAUTION)

    def _noise_of(self, unexplained: float, free: int) -> float:
        """Variance of the noise, going by what the frame leaves of its measurements.

        Of the misfit the iterations have explained what a sparse frame can; noise is hardly
        explained, but for the part that as many free numbers as there are pressed taxels take
        up. Infinite where these are too many to tell.
        """
        return unexplained / (self.phi.m - free) if free <= self.phi.m / 2 else math.inf

    def _numpy_forces(self, x_and_zero: Floats, bias: float) -> Floats:
        """Forces of all cells, from a vector of means above the bias with a 0 behind it."""
        forces = x_and_zero.take(self._place_of_cell, None, None, "clip")
        self._bias.give_back(forces)
        return forces
