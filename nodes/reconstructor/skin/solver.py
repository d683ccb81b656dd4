"""Orthogonal approximate message passing with learned gates, filtered over time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.identity import SubsamplePhi
from sparseskin.nodes.compressor.phi.sbhe import is_sbhe
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import TINY, Floats, Mask
from sparseskin.nodes.numerics.compiled import use_compiled
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.solvers.base import MAX_ITERATIONS, Solver, whole_number

from .gates import SHIFTS, Gates, Tiles, gates_of
from .rows import rows_of
from .tuning import SkinTuning
from .vectors import FrameVectors, Settled, Steps

RESOLUTION = float(np.finfo(np.float32).eps)
"""Relative resolution of measurements: a noise below it does not show in them."""
CONVERGED, N_FORMULA = 8, 3
"""Steps of a frame that need no others before them; steps by the formula before fewer. Measured on
five recordings and on presses at N/3: 3 and 1 have less error than 3 alone, in less time."""
REPEATED = 1e6
"""Noise variance of a measurement that repeats exactly, in that of others."""
INVISIBLE = 1e-3
"""Force that is returned as 0, in deviations of the noise: what earlier contacts leave."""
DUST = 1e-6
"""Squared length of Phi 1 a taxel up to which it is 0 but for rounding: no row of the subset sees
a bias. Derived: float32 leaves 1e-12, one row of +1 has 32 / N, above 1e-6 up to 3e7 taxels."""


class SkinSolver(Solver):
    """Reconstructs frames in a constant number of steps, with the estimated error of each.

    1. The bias b of noise that is clipped at 0 is subtracted from the measurements.
    2. The last frame x predicts this one: x_p = (1 + a0) x + a1 dx/drow + a2 dx/dcol, by ridge
       least squares on the innovation, scaled by what it explains.
    3. The noise variance R is the part of the innovation that does not repeat when the same rows
       are read again. P + R is its mean square: P, averaged over frames, is the error variance of
       the prediction.
    4. Each row has a Kalman filter of its own, of mean w and variance n + g: what the noise of its
       measurements left, and what has changed since. The mean moves as the prediction does; what
       the mean squared innovation of the rows read exceeds n + g + R by has changed in all rows.
       The prediction, of variance L = c P (1 + d P / R), and the filter give the expected value of
       each row, by their precisions; regression on the rows read gives the part of what the filter
       adds that counts. With the measurements, these are the target of each row, of variance v.
    5. Steps from z = x_p: r = target - W z; tau = mean r^2, less the mean v, of the rows read;
       D = tau / (tau + v); s^2 = tau (1 - mean D) / mean D; u = z + W^T (D r) / mean D;
       x, alpha = `Gates` of u / s, or `shrink` of it in the first steps of a frame that has few;
       z moves half the way to (x - alpha u) / (1 - alpha).
    6. The errors of z do not depend on the noise of the measurements: their mean squared residual
       less R is the error variance E of the last three x; where that is within the noise, alpha s^2
       counts. The estimate is the mean of these x and of x_p, by E and P.

    One solver serves all row subsets of rotating rows. Any Phi will do: its rows are made
    orthonormal first, whatever their length. Of a Phi that reads single taxels the error is not
    known. Each frame takes the same number of steps.

    Parameters
    ----------
    phi, mask
        As in `Solver`.
    basis : Basis
        Gives the size of the grid; the gates are learned.
    iterations : int
        Steps of a frame, 1..1000. Fewer than 8 follow `N_FORMULA` steps by a formula, each a few
        times as fast; fewer than 5 have not converged where a contact begins.
    fast : str
        Use of compiled loops, for "sbhe": "auto" (where numba is installed), "on" or "off".
    gates : Gates or str, optional
        Weights of the denoiser, or the path of their .npz file; "formula": none, all steps are
        those of `shrink`. None: the weights of the package.
    tuning : SkinTuning
        The constants of the method; another one is an ablation.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.

    Notes
    -----
    Source: Ma, Ping, "Orthogonal AMP", IEEE Access 5, 2017; Metzler, Mousavi, Baraniuk, "Learned
    D-AMP", NeurIPS 2017, for a learned denoiser in it; Mehra, "On the identification of variances
    and adaptive Kalman filtering", IEEE Trans. Automatic Control 15(2), 1970, for the noise level.
    """

    name = "skin"
    rotates = True
    adaptive = True
    paces = (1, 3, 5, 8)
    #: The sum of squares of larger ones could overflow float32.
    y_max = 1e14

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int = 8,
        fast: str = "auto",
        gates: Gates | str | None = None,
        tuning: SkinTuning | None = None,
    ) -> None:
        super().__init__(phi, basis, mask)
        self.n_steps = self.iterations = whole_number(
            self.name, "iterations", iterations, 1, MAX_ITERATIONS
        )
        if tuning is not None and not isinstance(tuning, SkinTuning):
            allowed = "allowed: SkinTuning, from Python only"
            raise SolverError(f"{self.name}: tuning = {tuning!r} is not allowed; {allowed}")
        self._t = tuning or SkinTuning()
        compiled = use_compiled(fast) and is_sbhe(phi)
        self._rows = rows_of(phi, compiled)
        self._cells = self.taxels[self._rows.taxel]
        flat = np.full(self.mask.size, phi.n, dtype=np.intp)
        flat[self._cells] = np.arange(phi.n)
        places = flat.reshape(self.mask.shape)
        made = self._rows, Tiles(self.mask, places, phi.n), gates_of(gates)
        if compiled:
            from .compiled import CompiledVectors  # needs numba

            self._vectors: FrameVectors = CompiledVectors(*made, places, self._t)
        else:
            self._vectors = FrameVectors(*made, places, self._t)
        #: By row subset: Phi 1 and its squared length; the last measurements and innovation.
        self._ones: dict[str, tuple[Floats, float]] = {}
        self._last: dict[str, tuple[Floats, Floats]] = {}
        self.reset()

    def reset(self) -> None:
        self._vectors.forget()
        self._last.clear()
        self._noise = self._least_noise = self._floor = self._bias = 0.0
        self._n_frames = self._n_seen = self._n_shifts = self._steps_left = 0
        self._trust = 1.0
        self._last_error2 = self._signal = 0.0
        self.error, self.trusted = None, True

    def use(self, phi: Phi) -> None:
        if (phi.n, phi.m) != (self.phi.n, self.phi.m):
            raise SolverError(
                f"{self.name}: phi {phi.fingerprint} is {phi.m} x {phi.n}; "
                f"allowed: {self.phi.m} x {self.phi.n}"
            )
        super().use(phi)
        self.phi = phi
        if not self._rows.use(phi):
            self._vectors.forget_rows()

    @property
    def bias(self) -> float:
        """Mean reading of an untouched taxel whose noise is clipped at 0, as known so far."""
        return self._bias

    @property
    def noise2(self) -> float:
        """Noise variance of a measurement, as known so far."""
        return self._noise

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        y = self._shaped_y(y)
        power = self._power_of(y) / y.size
        vectors, t = self._vectors, self._t
        if warm is not None:
            vectors.start_from(np.maximum(self._checked_warm(warm).reshape(-1)[self._cells], 0))
        # Of this frame alone: one frame of garbage must not blind those after it.
        self._floor = max(RESOLUTION**2 * power, TINY)
        self._values = self._rows.values(y) - np.float32(self._bias) * self._ones_of()[0]
        vectors.predict(self._values, max(self._noise, self._floor))
        e2 = vectors.innovation2
        last = self._last.get(self.phi.fingerprint)
        self._repeats = last is not None and np.array_equal(y, last[0])
        noise = self._follow_noise(last[1] if last and not self._repeats else None, e2)
        self._last[self.phi.fingerprint] = y, vectors.innovation
        signal = self._follow_signal(e2, noise)
        # Of rows that are never read, the innovation says nothing: the last estimate's own error.
        least = max(self._last_error2, self._floor)
        # A measurement that repeats exactly is not another one.
        doubt = REPEATED * noise if self._repeats else noise
        vectors.filter_rows(self._values, doubt, signal, least, self._floor)
        self._steps = Steps(vectors.predicted[np.newaxis], [signal], [e2])
        # Noise grows with the forces, but not without bound: what exceeds it, no force explains.
        known = self._n_seen > 1 / t.noise_rate
        self._judged_noise = min(noise, t.louder * self._least_noise) if known else noise
        self._steps_left = self.n_steps

    def _ones_of(self) -> tuple[Floats, float]:
        """Phi 1 of the row subset, float32 (n_read,), and its squared length."""
        key = self.phi.fingerprint
        if key not in self._ones:
            ones = self._rows.forward(np.ones(self._rows.n, dtype=np.float32))[self._rows.read]
            self._ones[key] = ones, float(ones @ ones)
        return self._ones[key]

    def _follow_noise(self, last: Floats | None, e2: float) -> float:
        """Update the noise level; return it times the trust in it.

        e2 is the mean square of the innovation, `last` the innovation when these rows were read
        before, None where that shows no noise. Where an innovation points along the last
        correction, that was too small: what seems noise is motion.
        """
        t = self._t
        if last is not None:
            changed = last - self._vectors.innovation
            seen = max(0.0, float(last @ changed) / last.size)
            self._n_seen += 1
            level = self._noise + max(t.noise_rate, 1 / self._n_seen) * (seen - self._noise)
            if self._n_seen > 1 / t.noise_rate:
                level = min(level, t.noise_growth * self._noise)
                self._least_noise = min(t.bias_forgotten * self._least_noise, level)
            else:
                self._least_noise = level
            self._noise = min(level, e2)
        self._noise = max(self._noise, self._floor, self.noise_sd**2)
        lagging = t.lagging / math.sqrt(self._values.size)
        self._trust *= math.exp(min(lagging - self._vectors.alike, t.trust_growth))
        self._trust = min(max(self._trust, t.least_trust), 1.0)
        return max(self._noise * self._trust, self._floor)

    def _follow_signal(self, e2: float, noise: float) -> float:
        """Mean squared error of the prediction: the excess of e2 over the noise, averaged."""
        n_read = self._values.size
        now = self._t.surplus(e2, noise, n_read)
        self._signal += self._t.signal_rate * (e2 - noise - self._signal)
        most = max(0.0, e2 - noise) + 2 * noise * math.sqrt(2 / n_read)
        self._signal = max(min(self._signal, most), now / 2)
        return max(0.0, self._signal, now)

    def step(self) -> None:
        self._count_step()  # `finish` does all of them in one call

    def finish(self) -> Floats:
        n, self._steps_left = self.n_steps - self._steps_left, 0
        t, noise = self._t, self._judged_noise
        if n:
            n_formula = N_FORMULA if self.n_steps < CONVERGED else 0
            self._steps = self._vectors.steps(self._n_shifts, self._floor, n_formula, n)
            self._n_shifts = (self._n_shifts + n_formula + n) % len(SHIFTS)
        error2 = self._error2()
        prior = t.blend * max(self._signal, self._last_error2, self._floor)
        part = error2 / (error2 + prior)
        sds = math.sqrt(self._least_noise), INVISIBLE * math.sqrt(noise)
        ones = self._ones_of()[0]
        settled = self._vectors.settle(
            self._steps.estimates, part, self._values, ones, self._bias, *sds
        )
        power = settled.power
        # What the noise of measurements left in the last estimate, the same measurements leave.
        left = min(self._last_error2, noise) if self._repeats else 0.0
        self._last_error2 = max((1 - part) * error2, left)
        self.error = math.sqrt(self._last_error2)
        # Until it is known, the bias passes for forces on all taxels.
        most = t.untouched if self._n_frames > t.bias_known else t.most_bias**2
        of_skin = noise / self._trust  # whatever passes for it in motion
        untouched = power <= most * of_skin and settled.residual2 <= t.unexplained * of_skin
        self.trusted = untouched or self._last_error2 <= t.trusted**2 * power
        if isinstance(self.phi, SubsamplePhi):  # its residuals show no error between its taxels
            self.error, self.trusted = None, True
        if not self._repeats:
            self._follow_bias(settled)
        image = np.zeros(self.mask.size, dtype=np.float32)
        image[self._cells] = settled.forces
        return self._finite(image.reshape(self.mask.shape))

    def _error2(self) -> float:
        """Mean squared error of the mean of the last estimates.

        The errors of z do not depend on the noise of the measurements: the residuals exceed the
        noise by them. Where that is not significant, the gates' own expectation counts.
        """
        t, noise = self._t, self._judged_noise
        own = _mean(self._steps.errors[-t.averaged :])
        seen = max(0.0, self._residual2() - noise)
        doubt = t.doubtful * (seen + noise) * math.sqrt(2 / self._values.size)
        share = seen * seen / (seen * seen + doubt * doubt + TINY)
        return share * seen + (1 - share) * own

    def _residual2(self) -> float:
        """Mean squared residual of the last z."""
        return _mean(self._steps.residuals[-self._t.averaged :])

    def _follow_bias(self, settled: Settled) -> None:
        """Update the mean reading of an untouched taxel: by residual along Phi 1, and taxels."""
        t, n, energy = self._t, self._rows.n, self._ones_of()[1]
        noise = math.sqrt(self._least_noise)
        more = settled.along / energy if energy > DUST * n else 0.0
        more += settled.unpressed / n
        self._n_frames += 1
        rate = max(t.bias_rate, t.bias_begins / (self._n_frames + t.bias_begins))
        bias = self._bias + rate * min(max(more, -noise / 2), noise / 2)
        self._bias = min(max(bias, 0.0), t.most_bias * noise)
        if self._bias < 1e-3 * noise:  # its reciprocal could overflow float32
            self._bias = 0.0


def _mean(numbers: Sequence[float]) -> float:
    return sum(numbers) / len(numbers)
