"""The default solver: randomly shifted Haar or a smooth model, and a prediction from the past."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.sbhe import is_sbhe
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import TINY, Floats, Indices, Mask
from sparseskin.nodes.numerics.compiled import use_compiled
from sparseskin.nodes.numerics.programs import run
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.bases.shifted_haar import SHIFTS, ShiftedHaar
from sparseskin.nodes.reconstructor.solvers.base import MAX_ITERATIONS, Solver, whole_number
from sparseskin.nodes.reconstructor.solvers.projection import CompiledProjection, make_projection

from .clip_bias import ClipBias
from .evidence import HAAR, SMOOTH, HeldOut, mean_square
from .gain import AdaptiveGain
from .noise_level import NoiseLevel, row_power
from .prediction import Prediction, neighbours_of
from .row_memory import RowMemory
from .smooth import SmoothModel
from .sums import Read, Tested
from .tuning import TUNING, SkinTuning

if TYPE_CHECKING:
    from .fast import CompiledFrame

N_DRAWN = 4093
"""Number of shifts drawn in advance; a prime, so that their sequence is in step with nothing."""

MOST_LATE = 5.0
"""Periods of the frames that stated work may take before comparisons wait; chosen: a first frame,
3.75 times one that has a prediction, is compared wherever the latter fits into a period."""


class SkinSolver(Solver):
    """Reconstructs frames from measurements, the last frame, and noise statistics of its own.

    1. Noise clipped at 0 biases untouched taxels: the bias is estimated and subtracted
       (`ClipBias`).
    2. The last frame, moved affinely, predicts this one: x_p (`Prediction`).
    3. The innovation e = y - Phi x_p and the noise level (`NoiseLevel`) give the gain K
       (`AdaptiveGain`) of the target y' = Phi x_p + K e, K = 1 if the scene has jumped.
    4. Iterations from x_p: r = y' - Phi z, u = z + Phi^T r, x = max(0, Psi_s g(Psi_s^T u)),
       z = x + 0.7 (x - x_before). Psi_s is three levels of Haar under a random shift s
       (`ShiftedHaar`), g(c) = c max(0, 1 - lambda^2 / c^2) the nonnegative garrote, lambda 1.4
       RMS of r, bounded from below by noise and innovation. The number of iterations grows with
       the normalised innovation squared.
    5. The mean of the last iterates, and the bias added back to touched taxels.
    6. Some measurements are held out of all this (`HeldOut`). Where their residuals exceed the
       noise, the frame is estimated by another model, too (`SmoothModel`), and the better of both
       is used. They also give the error of the estimate, and whether it is trusted.

    With rotating rows, one solver serves all row subsets (`use`): the prediction carries over, and
    noise, bias and gain are kept for each. A wrong estimate that fits the rows of one frame is
    contradicted by the next; on a still skin, earlier measurements of other rows are part of the
    target (`RowMemory`).

    Step length, noise and threshold come from the measurements: relative errors are the same on a
    skin of another range. The same measurements give the same bits on one machine: shifts are drawn
    from a generator that `reset` restarts.

    Parameters
    ----------
    phi, mask
        As in `Solver`. "sbhe" with blocks of at most 64 is several times faster than others.
    basis : Basis
        Gives the size of the grid; the solver has its own Haar.
    iterations : int, optional
        Least iterations of a frame, 1..1000. None: 3 at M = N/3 and N/4, 4 at N/8, more with fewer
        measurements.
    max_iterations : int
        Most iterations of a frame, 1..1000, rounds of the smooth model not counted; never fewer
        than `iterations`.
    seed : int
        Seed of the shifts, at least 0.
    fast : str
        Use of compiled loops, for "sbhe": "auto" (where numba is installed), "on" or "off". The
        forces are the same to within some 1e-5 N at M = N/3. With far fewer measurements the method
        amplifies rounding: measurements that differ by 1e-7 N make as large a difference. So does
        the smooth model at any M.
    tuning : SkinTuning
        The constants of the method; another one is an ablation.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.

    Notes
    -----
    Source: a denoiser within the iteration: Metzler, Maleki, Baraniuk, "From denoising to
    compressed sensing", IEEE Trans. Information Theory 62(9), 2016. Those of the parts: there.
    """

    name = "skin"
    rotates = True
    adaptive = True
    #: The sum of squares of larger ones could overflow float32.
    y_max = 1e14

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int | None = None,
        max_iterations: int = 30,
        seed: int = 0,
        fast: str = "auto",
        tuning: SkinTuning = TUNING,
    ) -> None:
        super().__init__(phi, basis, mask)
        if not isinstance(tuning, SkinTuning):
            raise SolverError(
                f"skin: tuning = {tuning!r} is not allowed; allowed: a SkinTuning, from Python only"
            )
        self._t = tuning
        bounds = checked_iterations("skin", phi.ratio, iterations, max_iterations)
        self.iterations, self.max_iterations = bounds
        whole_number("skin", "seed", seed, 0, 2**32 - 1)

        n = phi.n
        self._subsets = {phi.fingerprint: 0}
        compiled = use_compiled(fast) and is_sbhe(phi)
        self._projection = make_projection(phi, compiled)
        self._place_of_cell = np.full(self.mask.size, n, dtype=np.intp)
        self._place_of_cell[self.taxels[self._projection.order]] = np.arange(n)
        places = self._place_of_cell.reshape(self.mask.shape)
        self._haar = ShiftedHaar(self.mask.shape, places, n)
        neighbours = neighbours_of(places, n)
        self._prediction = Prediction(self._projection, neighbours, n, phi.m, tuning)
        self._noise = NoiseLevel(phi.m, tuning)
        self._row_power = row_power(phi)
        self._bias = ClipBias(self._projection, n, tuning)
        few = phi.m < tuning.comparable and n <= tuning.most_direct
        self._held_out = HeldOut(self._projection, n, phi.m, few, tuning)
        self._smooth = self._smooth_model(compiled, few)
        self._gain = AdaptiveGain(tuning)
        self._memory: RowMemory | None = None
        if self._projection.has_whole:
            self._memory = RowMemory(self._projection, phi.m, self._prediction.whole, tuning)
        rng = np.random.default_rng(seed)
        drawn: list[int] = rng.integers(len(SHIFTS), size=N_DRAWN).tolist()
        #: As many more follow as a frame may need after the last one.
        self._shifts = drawn + drawn[:MAX_ITERATIONS]

        def floats(size: int) -> Floats:
            return np.zeros(size, dtype=np.float32)

        # Vectors of taxels end with a 0, which cells without a taxel read.
        self._x_and_zero, self._u_and_zero = floats(n + 1), floats(n + 1)
        self._x, self._u = self._x_and_zero[:n], self._u_and_zero[:n]
        self._before, self._z, self._sum = floats(n), floats(n), floats(n)
        rows = (floats(self._projection.n_rows) for _ in range(5))
        self._y, self._innovation, self._target, self._r, self._correction = rows
        self._fitted = {name: floats(self._projection.n_rows) for name in (HAAR, SMOOTH)}
        self._canvas = floats(self._haar.size)
        # An array of them: numpy compares with a single number three times as slowly.
        self._zeros = floats(n)
        self._lambda2 = np.zeros((), dtype=np.float32)
        self._momentum = np.array(tuning.momentum, dtype=np.float32)
        self._factor = np.zeros((), dtype=np.float32)
        self._shrink = self._haar.shrinking(self._canvas, self._lambda2)
        #: The work of a frame in compiled loops, or None: with numpy.
        self._frame: CompiledFrame | None = None
        if compiled:
            self._compile(neighbours)
        self.n_steps = self.iterations
        self.reset()

    def _compile(self, neighbours: Indices) -> None:
        """Replace the work of a frame by compiled loops, and its vectors by theirs."""
        # Imported here: they need numba.

        from .fast import CompiledFrame

        projection = self._projection
        assert isinstance(projection, CompiledProjection)
        self._frame = frame = CompiledFrame(
            *(projection, self._haar, self._place_of_cell, neighbours, self._shifts, self._t)
        )
        self._x_and_zero, self._x, self._z = frame.x_and_zero, frame.x, frame.z
        self._y, self._sum, self._correction = frame.y, frame.total, frame.correction
        self._fitted[HAAR], self._prediction.whole = frame.fitted, frame.whole
        self._memory = RowMemory(projection, self.phi.m, frame.whole, self._t)
        self._memory.known, self._memory.values = frame.known, frame.values
        frame.use(0, self._held_out.kept, self._bias.ones)

    def _smooth_model(self, compiled: bool, direct: bool) -> SmoothModel:
        cells = self.taxels[self._projection.order]
        if direct or not compiled:
            return SmoothModel(self._projection, cells, self.mask, direct, self._t)
        # Imported here: they need numba.

        from .fast import CompiledSmoothModel

        assert isinstance(self._projection, CompiledProjection)
        return CompiledSmoothModel(self._projection, cells, self.mask, self._t)

    def reset(self) -> None:
        self._x.fill(0)
        self._noise.reset()
        self._bias.reset()
        self._gain.reset()
        self._held_out.reset()
        self.error, self.trusted = None, True
        #: Last estimates of both models, while they are compared.
        self._last: dict[str, Floats] = {}
        if self._memory is not None:
            self._memory.forget()
        self._correction.fill(0)
        self._prediction.knows_whole = False
        self._last_phi = self.phi
        self._rotating = self._begun = self._has_estimate = False
        self.put_off = self._is_owed = False
        self._busy_s = 0.0
        subset = self._subsets[self.phi.fingerprint]
        self._noise.use(subset)
        self._gain.use(subset)
        self._held_out.use(subset)
        self._next_shift = 0
        self._steps_left = 0

    def use(self, phi: Phi) -> None:
        """Expect measurements of other rows of the same W, or raise SolverError by their number."""
        if (phi.n, phi.m) != (self.phi.n, self.phi.m):
            raise SolverError(
                f"skin: phi {phi.fingerprint} is {phi.m} x {phi.n}; "
                f"allowed: {self.phi.m} x {self.phi.n}"
            )
        super().use(phi)
        subset = self._subsets.setdefault(phi.fingerprint, len(self._subsets))
        if not self._projection.has_whole and phi is not self.phi:
            self._correction.fill(0)  # it is known for the rows of the last frame alone
        self.phi = phi
        self._projection.use(phi)
        self._noise.use(subset)
        self._bias.use(subset)
        self._gain.use(subset)
        self._held_out.use(subset)
        if self._frame is not None:
            self._frame.use(subset, self._held_out.kept, self._bias.ones)

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        y = self._shaped_y(y)
        if warm is not None:
            self._power_of(y)
            cells = self.taxels[self._projection.order]
            self._checked_warm(warm).reshape(-1).take(cells, None, self._x, "clip")
            np.maximum(self._x, 0, out=self._x)
            self._correction.fill(0)
            self._prediction.knows_whole = False
            self._has_estimate = bool(self._x.any())
        rotating = self._rotating or (self._begun and self.phi is not self._last_phi)
        # Whether rows rotate shows in the second frame, which remembers the first.
        remembers = self._memory is not None and (rotating or not self._begun)
        found = self._read(y, remembers)
        self._begun, self._rotating, self._last_phi = True, rotating, self.phi
        self._power_read = found.power / self.phi.m
        e2 = found.e2 / self.phi.m
        failed = self._prediction.failed
        self._noise.stated = self._row_power * self.noise_sd**2
        self._noise.follow(e2, found.changed2, found.second2, failed, self._power_read)
        jumped, settling = self._noise.jumped, self._noise.since_jump <= self._t.settling
        self._gain.follow(
            *(found.e2, found.along, found.correction2, self.phi.m, self._noise.s2, settling)
        )
        gain = self._gain.gain

        held = self._t.held_rotating if self._rotating else self._t.held_threshold
        noise = self._t.least_threshold * math.sqrt(self._gain.noise * gain)
        least = 0.0 if jumped else max(noise, held * math.sqrt(e2) * gain)
        self._least = least * self._projection.step_size
        cold = self._t.cold_threshold / math.sqrt(self.phi.ratio)
        threshold = min(self._t.threshold, cold) if jumped else self._t.threshold
        self._threshold = threshold * self._projection.step_size
        more = self._t.iterations_per_nis * max(0.0, self._gain.nis - self._t.expected_nis)
        more = self.max_iterations if settling else min(more, self.max_iterations)
        # A comparison that was put off is made from nothing, and decides at once.
        self._is_owed, self.put_off = self.put_off, False
        models = self._held_out.models(self._nothing_known or self._is_owed, self._coarse)
        # By stated times, not by the clock: the same frames have the same forces, live or not.
        if self._smooth.least_s > self.period_s and self.phi.m >= self._t.comparable:
            models = (HAAR,)
        self._busy_s = max(0.0, self._busy_s - self.period_s)
        self._n_haar = (
            min(self.max_iterations, self.iterations + int(more)) if HAAR in models else 0
        )
        counted = None
        if self._memory is not None and remembers:
            # While the estimate settles after a jump, earlier rows would preserve its errors.
            subset = self._subsets[self.phi.fingerprint]
            counted = self._memory.counted(subset, found.change2, self.known_noise, e2, settling)
            # Thresholds are in RMS of r over the weighted rows.
            self._threshold *= math.sqrt(self.phi.m / self._memory.m_counted)
        self._aim(gain, counted)
        self.unfitted = self._held_out.measurements
        self._n_rounds, self._needs_smooth = 0, True
        self._residuals: dict[str, Floats] = {}
        if SMOOTH in models:
            self._begin_smooth(e2, remembers)
        start = self._start_of(HAAR)
        if HAAR in models and start is not self._x:
            np.copyto(self._x, start)
            np.copyto(self._z, start)
        self.n_steps = self._n_haar + self._n_rounds
        self._steps_left, self._n_summed = self.n_steps, 0

    def _read(self, y: Floats, remembers: bool) -> Read:
        """Read the measurements of a frame, float32 (m,), and predict it.

        The last rows are moved along if the frame `remembers` them.
        """
        memory, prediction = self._memory, self._prediction
        if self._frame is not None:
            found = self._frame.read(
                *(y, self._noise, prediction, self._bias.b, remembers, self.y_max**2)
            )
            if not found.power < self.y_max**2:
                self._power_of(y)  # raises SolverError, or they are large, but not too large
                found = self._frame.read(
                    *(y, self._noise, prediction, self._bias.b, remembers, math.inf)
                )
            if remembers and prediction.failed and memory is not None:
                memory.forget_times()
            return found
        power = self._power_of(y)
        self._projection.rows_of(y, self._y)
        self._bias.subtract(self._y)
        self._projection.weigh(None)
        changed2, second2 = self._noise.changes(y)
        e2 = prediction.predict(self._x, self._y, self._innovation, self._noise.s2, changed2)
        correction = np.multiply(self._correction, self._projection.read, self._r)
        along = float(np.dot(self._innovation, correction))
        correction2, change2 = float(np.dot(correction, correction)), 0.0
        if memory is not None and remembers:
            if prediction.failed:
                memory.forget()
            change2 = memory.compare(self._x if prediction.moved else None, self._y)
        elif prediction.moved:
            np.subtract(self._y, self._innovation, prediction.whole)
        return Read(power, changed2, second2, e2, along, correction2, change2)

    def _aim(self, gain: float, counted: float | None) -> None:
        """Set the target and the weights of the rows, and begin the iterations at x.

        Rows of earlier frames have the weight `counted`; None: they are not remembered.
        """
        if self._frame is not None:
            self._frame.aim(gain, counted)
            return
        if counted is not None and self._memory is not None:
            self._memory.follow(gain, counted, self._target)
        else:
            # y' = Phi x_p + K e
            self._factor[()] = 1 - gain
            np.multiply(self._innovation, self._factor, self._target)
            np.subtract(self._y, self._target, self._target)
        self._projection.leave_out(self._held_out.kept)
        np.multiply(self._target, self._held_out.kept, self._target)
        np.copyto(self._z, self._x)
        self._sum.fill(0)

    def _begin_smooth(self, e2: float, rotating: bool) -> None:
        """Hand the rows that are known to the smooth model."""
        y = self._y
        y2 = float(np.dot(y, y)) / self.phi.m
        cold = self._nothing_known or self._is_owed
        least = self.known_noise + self._t.least_noise * y2
        power = (y2 if cold else e2) - least
        known, values, variance = self._projection.measured, y, np.full_like(y, least)
        if rotating and self._memory is not None:
            known, values = self._memory.known, self._memory.values
            variance = self._memory.variances(least)
        used = np.where(known > 0, self._held_out.kept, np.float32(0))
        kept = self._t.kept_rotating if rotating else self._t.kept_fixed
        start = self._start_of(SMOOTH)
        self._smooth.setup(start, values, variance, used, max(power, TINY), cold, kept)
        self._n_rounds = self._smooth.rounds_left

    def _start_of(self, model: str) -> Floats:
        """Return the prediction for a model: while two are compared, the last estimate of each."""
        other = model != self.model and not self._nothing_known
        return self._last.get(model, self._x) if other else self._x

    def solve(self, y: Floats, warm: Floats | None = None) -> Floats:
        self._check_subset()
        self.setup(y, warm)
        self._iterate(0, self._n_haar)
        self._steps_left -= self._n_haar
        while self._steps_left:
            self.step()
        return self.finish()

    def step(self) -> None:
        done = self.n_steps - self._steps_left
        self._count_step()
        if done < self._n_haar:
            self._iterate(done, 1)
            return
        if done == self._n_haar and done:
            self._test_haar()
            self._needs_smooth = not self._held_out.suffices(
                self._residuals[HAAR], self.known_noise
            )
            # A model in use is computed in any case, unless the past says nothing.
            deferrable = self.model == HAAR or self._nothing_known or self._is_owed
            busy_s = self._busy_s + self._smooth.left_s
            in_time = busy_s <= MOST_LATE * self.period_s
            if self._needs_smooth and deferrable and not (in_time and self.may_compare()):
                self._needs_smooth, self.put_off = False, True
            if self._needs_smooth:
                self._busy_s = busy_s
        if self._needs_smooth:
            self._smooth.round()

    def _iterate(self, done: int, count: int) -> None:
        """Do iterations of the Haar model, after the first `done` of the frame."""
        # The mean of the last ones is the estimate.
        n_summed = min(count, max(0, done + count - self._n_haar + self._t.averaged))
        first = self._next_shift
        self._next_shift = (first + count) % N_DRAWN
        self._n_summed += n_summed
        if self._frame is not None:
            self._frame.iterate(first, count, n_summed, self._threshold, self._least)
            return
        for k in range(count):
            shift, summed = self._shifts[first + k], k >= count - n_summed
            self._numpy_iteration(shift, self._threshold, self._least, summed)

    def _numpy_iteration(self, shift: int, threshold: float, least: float, summed: bool) -> None:
        """Do one iteration under a shift; `threshold` in RMS of r, `least` in newtons."""
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
        if self._steps_left < self.n_steps:
            sums, fitted = self._choose()
        else:
            fitted = self._prediction.whole
            sums = self._sums_of(self._x, fitted)
        if not math.isfinite(sums.x2):
            self.reset()
            raise SolverError("skin: the iteration diverged: is phi.lipschitz too small?")
        self._steps_left = 0
        # W of the correction x - x_p, and of the last frame.
        if self._frame is not None:
            forces = self._frame.end(fitted, self._bias.b)
        else:
            np.subtract(fitted, self._prediction.whole, self._correction)
            np.copyto(self._prediction.whole, fitted)
            forces = self._x_and_zero.take(self._place_of_cell, None, None, "clip")
            self._bias.add_back(forces)
        return self._finite(forces).reshape(self.mask.shape)

    @property
    def model(self) -> str:
        """Model of the last estimate: "haar" or "smooth"."""
        return self._held_out.model

    def _choose(self) -> tuple[Tested, Floats]:
        """Set x to the better estimate of those that were made, and its error.

        Return its sums and W x.
        """
        done = self.n_steps - self._steps_left
        estimates = {}
        if self._n_haar:
            if HAAR not in self._residuals:
                self._test_haar()
            estimates[HAAR] = self._x
        # A model that a budget cut short is not compared, but better than none.
        complete = done == self.n_steps and self._needs_smooth
        if self._n_rounds and (complete or not self._n_haar):
            estimates[SMOOTH] = self._smooth.x
            self._projection.whole(self._smooth.x, self._fitted[SMOOTH])
            self._residuals[SMOOTH] = self._residual_of(SMOOTH)
        before = self.model
        # Only rotating rows hold out others in the next frame: with fixed ones, all noise counts.
        gain = self._gain.gain if self._rotating else 0.0
        owed = self._is_owed and len(self._residuals) > 1
        chosen = self._held_out.choose(
            self._residuals, self.known_noise, self._nothing_known or owed, gain
        )
        if (before, chosen) == (SMOOTH, HAAR):
            # The gain has fallen meanwhile, without the noise of the smooth model.
            self._noise.since_jump = 0
        self._last = {}
        if len(estimates) > 1:
            self._last = {model: x.copy() for model, x in estimates.items()}
        fitted = self._fitted[chosen]
        if chosen == SMOOTH:
            np.copyto(self._x, estimates[SMOOTH])
        sums = self._haar_sums if chosen == HAAR else self._sums_of(self._x, fitted)
        if self._noise.known or self.phi.m >= self._t.comparable:
            # The bias is that of this frame's rows alone.
            most = self._most_noise(self._residuals[chosen])
            self._bias.update(sums.left, self._x, self._noise.s2, most, self._noise.again)
        self._prediction.knows_whole = True
        self._has_estimate = True
        self._judge(sums)
        return sums, fitted

    def _test_haar(self) -> None:
        """Set x to the mean of the last iterates, and test it."""
        factor, fitted = 1 / self._n_summed if self._n_summed else 0.0, self._fitted[HAAR]
        if self._frame is not None:
            self._haar_sums = self._frame.test(factor)
        else:
            if factor:
                self._factor[()] = factor
                np.multiply(self._sum, self._factor, self._x)
            self._projection.whole(self._x, fitted)
            self._haar_sums = self._sums_of(self._x, fitted)
        self._residuals[HAAR] = self._residual_of(HAAR)

    def _sums_of(self, x: Floats, fitted: Floats) -> Tested:
        """Return the sums of an estimate, float32 (n,), with W x `fitted`."""
        residual = np.subtract(self._y, fitted, self._r)
        left = float(np.dot(self._bias.ones, residual))
        return Tested(float(np.dot(x, x)), float(np.count_nonzero(x)), left)

    def _residual_of(self, model: str) -> Floats:
        """Return the residuals of the measurements that a model's estimate was not made from."""
        left_out = self._smooth.left_out
        if left_out is not None:
            return left_out[self._projection.measured > 0]
        return self._held_out.residual(self._y, self._fitted[model])

    @property
    def _nothing_known(self) -> bool:
        """True if the past says nothing of this frame."""
        return self._prediction.failed or not self._has_estimate

    @property
    def _coarse(self) -> bool:
        """True if the last error, and the noise, are large beside what touches the skin.

        Noise counts as far as the Haar model does not average it out, K times; with a low gain K,
        innovations are no larger than noise, and no other model would change that. Not asked of
        fixed rows: the same measurements are held out of each frame, so that another comparison
        would be no other evidence.
        """
        gain, noise = self._gain.gain, self.known_noise
        if self.error is None or not self._rotating or gain < self._t.coarse_gain:
            return False
        touch = self._power_read - noise
        if touch <= self._t.untouched * noise:
            return False
        return self.error**2 + gain * noise > self._t.trusted**2 * touch

    @property
    def known_noise(self) -> float:
        """Variance of the noise on a measurement, squared newtons; 0 before it is known."""
        return self._gain.noise if self._noise.known else 0.0

    def filtered_error2(self, x: Floats) -> float:
        """Mean squared error of a taxel that the noise leaves in an estimate x, float32 (n,)."""
        return self._filtered_error2(float(np.count_nonzero(x)))

    def _filtered_error2(self, n_touched: float) -> float:
        touched = math.sqrt(n_touched / self.phi.n)
        gain = self._gain.gain if self.model == HAAR else 1.0
        return self._t.filtered_error * touched * gain * self.known_noise

    def _most_noise(self, residual: Floats) -> float:
        """Return a bound of the noise variance before it is known, by held-out measurements."""
        if self._noise.known or not residual.size:
            return math.inf
        return self._t.bias_bound * mean_square(residual)

    def _judge(self, sums: Tested) -> None:
        """Set the error of the estimate, and whether it is trusted."""
        if not self._held_out.tests:
            self.error, self.trusted = None, True
            return
        noise = self.known_noise
        beyond = self._held_out.error2(noise)
        error2 = max(beyond, self._filtered_error2(sums.n_touched))
        power = sums.x2 / self.phi.n
        self.error = math.sqrt(error2)
        excess = max(power, min(beyond, self._power_read - noise))
        untouched = excess <= self._t.untouched * noise
        self.trusted = untouched or error2 <= self._t.trusted**2 * power


def checked_iterations(
    name: str, ratio: float, iterations: int | None, max_iterations: int
) -> tuple[int, int]:
    """Return the least and the most iterations of a frame; None: the default at that N / M.

    Raises SolverError, which begins with `name`, if one is no whole number in 1..1000.
    """
    if iterations is None:
        iterations = min(2 + round(ratio / 4), MAX_ITERATIONS)
    least = whole_number(name, "iterations", iterations, 1, MAX_ITERATIONS)
    most = whole_number(name, "max_iterations", max_iterations, 1, MAX_ITERATIONS)
    return least, max(most, least)
