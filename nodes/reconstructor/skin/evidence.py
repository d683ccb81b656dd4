"""Measurements held out of a solve: the error of an estimate, and the choice between two models."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.reconstructor.solvers.projection import Projection

from .tuning import TUNING, SkinTuning

HAAR, SMOOTH = "haar", "smooth"


class HeldOut:
    """Error of estimates, by measurements that they were not made from, and the choice of a model.

    Of each row subset the same measurements are held out in every frame: with fixed rows, what an
    earlier frame was fitted to would prove nothing. The mean square of their residuals is the
    mean squared error of a taxel plus the noise.

    Where there are few measurements, none is held out: the smooth model itself predicts each from
    all others.

    Parameters
    ----------
    projection, n, m
        The projection, and its numbers of taxels and of measurements. If all taxels are measured
        (m = n), there is nothing to predict.
    one_by_one : bool
        True if each measurement is predicted from all others.
    tuning : SkinTuning
        The constants.

    Attributes
    ----------
    model : str
        The model in use, `HAAR` or `SMOOTH`.
    kept : ndarray of float32, shape (n_rows,)
        0 for the rows that are held out of the current subset, else 1.
    measurements : ndarray of intp, shape (k,)
        The measurements that are held out of the current subset.
    tests : bool
        True if estimates are tested at all.

    Notes
    -----
    Source: Ward, "Compressed sensing with cross validation", IEEE Trans. Information Theory
    55(12), 2009.
    """

    def __init__(
        self,
        projection: Projection,
        n: int,
        m: int,
        one_by_one: bool,
        tuning: SkinTuning = TUNING,
    ) -> None:
        self._t = tuning
        self._projection, self._m = projection, m
        held = (
            0 if one_by_one or m == n else min(max(1, m // self._t.held_one_of), self._t.held_most)
        )
        self._n_held = held
        self._compares = held > 0 and m >= self._t.comparable
        self._first = HAAR if m >= self._t.comparable else SMOOTH
        self.tests = m < n and (one_by_one or held > 0)
        self._subsets: dict[int, tuple[Floats, Indices, Indices]] = {}
        self.reset()
        self.use(0)

    def reset(self) -> None:
        """Forget all frames."""
        self.model = self._first
        self._errors: dict[str, float] = {}
        self._seen: tuple[tuple[float, float], ...] = ()
        self._wait, self._period, self._left = 0, self._t.often, 0
        self._exceeds_noise, self._coarse = True, False
        self._most_noise = math.inf

    def use(self, subset: int) -> None:
        """Hold out measurements of this row subset, which the projection now is of."""
        if subset not in self._subsets:
            # The same measurements in whatever order a projection holds the rows.
            chosen = np.zeros(self._m, dtype=np.float32)
            rng = np.random.default_rng(subset)
            measurements = rng.choice(self._m, size=self._n_held, replace=False)
            chosen[measurements] = 1
            held = np.zeros(self._projection.n_rows, dtype=np.float32)
            self._projection.rows_of(chosen, held)
            self._subsets[subset] = 1 - held, np.flatnonzero(held), np.sort(measurements)
        self.kept, self._rows, self.measurements = self._subsets[subset]

    def models(self, failed: bool, coarse: bool) -> tuple[str, ...]:
        """Return the models that this frame is to be estimated by.

        `failed` if the prediction of the frame is worth nothing; `coarse` if the last error, and
        the noise, are large beside what touches the skin: then a noise level that is too high
        must not pass for the reason.
        """
        self._wait -= 1
        self._coarse = coarse
        doubted = self._exceeds_noise or coarse or self.model == SMOOTH
        due = self._wait <= 0 and doubted
        if self._compares and (failed or (due and not self._left)):
            self._left = self._t.trial
        if self._left:
            return HAAR, SMOOTH
        return (self.model,)

    def suffices(self, residual: Floats, noise: float) -> bool:
        """True if the residuals of held-out measurements may be noise: no model can be better.

        Residuals, float32, and the variance of the noise are as in `choose`.
        """
        noise = min(noise, self._most_noise)
        exceeds = _excess(mean_square(residual), noise, max(1, residual.size)) > 0
        return not (self._coarse or exceeds)

    def residual(self, y: Floats, fitted: Floats) -> Floats:
        """Return the held-out part of y - fitted; all are vectors of rows, float32."""
        residual: Floats = y[self._rows] - fitted[self._rows]
        return residual

    def choose(self, residuals: dict[str, Floats], noise: float, failed: bool, gain: float) -> str:
        """Process the estimates of a frame; return the model whose estimate is used.

        Parameters
        ----------
        residuals : dict
            Of each model, those of the measurements that its estimate was not made from, float32,
            newtons.
        noise : float
            Variance of the noise on a measurement, squared newtons; 0 where it is not known.
        failed : bool
            True if errors of earlier frames say nothing of this one.
        gain : float
            Part of the innovation that the Haar model adds to its prediction, 0..1: it averages the
            rest of the noise out.
        """
        errors, now = self._errors, {}
        read, noise = noise, min(noise, self._most_noise)
        for model, residual in residuals.items():
            now[model] = mean_square(residual)
            begins = failed or (
                len(residuals) == 2 and self._left == self._t.trial and model != self.model
            )
            last = now[model] if begins else errors.get(model, now[model])
            # Errors of a contact end with it.
            last = min(last, self._t.error_fading * now[model] + noise)
            errors[model] = self._t.error_memory * last + (1 - self._t.error_memory) * now[model]
            if len(residuals) == 1 and now[model] > self._t.worse * last:
                self._wait = 0
        # A residual is noise and error: it bounds the noise, which motion makes seem too large.
        if self._n_held:
            least = _slack(self._n_held * self._t.error_frames) * min(
                errors[model] for model in residuals
            )
            self._most_noise = min(self._most_noise, least)
        noise = min(read, self._most_noise)
        self._most_noise *= self._t.noise_growth_rotating
        if len(residuals) == 2:
            self._left -= 1
            if failed or not self._left:
                self._compare((1 - gain) * noise)
        else:
            (self.model,) = residuals
            self._left = 0
        chosen = self.model
        count = max(1, residuals[chosen].size)
        self._seen = (errors[chosen], count * self._t.error_frames), (now[chosen], count)
        self._exceeds_noise = self.error2(noise) > 0
        return chosen

    def error2(self, noise: float) -> float:
        """Return the mean squared error of the last estimate as far as noise cannot explain it.

        That is the excess over the noise, squared newtons, of the running mean or, where it is
        larger, of the last frame alone; twice the standard deviation of such a mean is noise, too.
        0 before the first frame.
        """
        return max([0.0, *(_excess(mean, noise, count) for mean, count in self._seen)])

    def _compare(self, averaged: float) -> None:
        """Choose a model by the errors of both, and when to compare them again.

        `averaged`: part of the noise variance that the Haar model averages out in time, which its
        errors do not show so soon. The smooth model follows each frame.
        """
        haar, smooth = self._errors[HAAR], self._errors[SMOOTH]
        clearly = 1 + 2 * self._t.margin / math.sqrt(self._n_held * self._t.error_frames)
        better = SMOOTH if haar > clearly * smooth + min(averaged, smooth) else HAAR
        if better != self.model or self._coarse:
            self._period = self._t.often
        elif not self._left:
            self._period = min(2 * self._period, self._t.seldom)
        self.model, self._wait = better, self._period


def mean_square(residual: Floats) -> float:
    """Return the mean square of residuals, float32 (k,); 0 of none."""
    return float(np.dot(residual, residual)) / max(1, residual.size)


def _excess(mean: float, noise: float, count: float) -> float:
    """Return a mean of squared residuals less what noise explains, squared newtons."""
    return mean - noise * _slack(count)


def _slack(count: float) -> float:
    """Return a variance and twice the standard deviation of a mean of `count` squared normal
    variables, in that variance.
    """
    return 1 + 2 * math.sqrt(2 / count)
