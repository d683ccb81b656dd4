"""The smooth model: a Gaussian field as its closed form has it, on any skin and Phi."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.base import RANDOM, make_phi
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask
from sparseskin.nodes.reconstructor.skin import smooth
from sparseskin.nodes.reconstructor.skin.smooth import MOST_DENSE, SmoothModel
from sparseskin.nodes.reconstructor.skin.tuning import TUNING
from sparseskin.nodes.reconstructor.solvers.projection import make_projection

WHOLE, LINE = np.ones((8, 8), dtype=np.bool_), np.ones((1, 40), dtype=np.bool_)
KINDS = ["sbhe", "gaussian", "subsample", "full"]
#: How the system is solved, and relative deviations from the closed form.
INVERSE, GRADIENTS, COMPILED = "inverse", "conjugate gradients", "compiled conjugate gradients"
CLOSE = {INVERSE: 1e-4, GRADIENTS: 1e-3, COMPILED: 1e-3}


def holes() -> Mask:
    mask = np.ones((8, 8), dtype=np.bool_)
    mask[0, :3] = False
    mask[4, 4] = False
    return mask


class Setting:
    """A skin and measurements of a smooth press, with W, places and K in float64."""

    def __init__(self, kind: str, mask: Mask, form: str, ratio: int = 3) -> None:
        n = int(mask.sum())
        # Rows without the sums of large blocks, along which a smooth press has most of its energy:
        # conjugate gradients that end at a part of the right side then leave more of the rest.
        self.phi = make_phi(kind, n, n if kind == "full" else n // ratio, 0, 32, RANDOM)
        self.projection = make_projection(self.phi, compiled=form == COMPILED)
        order = self.projection.order
        cells = np.flatnonzero(mask)[order]
        self.model = self.made(cells, mask, form)
        self.w = np.array([self.rows(column) for column in self.phi.dense()[:, order].T]).T
        self.places = np.stack(np.unravel_index(cells, mask.shape), axis=1)
        middle = 0.45 * np.array(mask.shape)
        self.x = np.exp(-0.5 * np.square(self.places - middle).sum(axis=1) / 1.5**2)
        measured = self.rows(np.ones(self.phi.m))
        rng = np.random.default_rng(0)
        noise = 0.02 * self.rows(rng.standard_normal(self.phi.m))
        self.y = (self.w @ self.x + noise).astype(np.float32)
        # Two of the measurements are not used.
        measured[np.flatnonzero(measured)[[1, 5]]] = 0
        self.used = measured.astype(np.float32)
        # Well-conditioned, and different for each row.
        power = float(np.mean(np.square(self.w @ self.x)))
        self.variance = (power * rng.uniform(0.1, 0.4, self.used.size)).astype(np.float32)

    def made(self, cells: Indices, mask: Mask, form: str) -> SmoothModel:
        if form != COMPILED:
            return SmoothModel(self.projection, cells, mask, direct=form == INVERSE)
        from sparseskin.nodes.reconstructor.skin.fast import CompiledSmoothModel

        return CompiledSmoothModel(self.projection, cells, mask)  # type: ignore[arg-type]

    def rows(self, y: Doubles) -> Doubles:
        """Measurements as a vector of rows."""
        out = np.zeros(self.projection.n_rows, dtype=np.float32)
        self.projection.rows_of(y.astype(np.float32), out)
        return out.astype(np.float64)

    def begin(self, x: Doubles | None = None, kept: float = 1.0) -> None:
        start = np.zeros(self.phi.n) if x is None else x
        given = start.astype(np.float32), self.y, self.variance, self.used
        self.model.setup(*given, power=1.0, cold=x is None, kept=kept)

    def bell(self, length: float) -> Doubles:
        distance2 = np.square(self.places[:, None] - self.places).sum(axis=2)
        found: Doubles = np.exp(-0.5 * distance2 / length**2)
        return found

    def deviation(self, x: Doubles) -> Doubles:
        """Standard deviations that follow from an estimate, the largest 1 and the floor."""
        blur = self.bell(TUNING.blur)
        blurred = blur @ x / blur.sum(axis=1)
        found: Doubles = blurred / blurred.max() + TUNING.deviation_floor
        return found

    def system(self, deviation: Doubles, known: Doubles) -> tuple[Doubles, Doubles]:
        """C W^T and W C W^T + V of the rows used, in units in which C has s^2 = 1."""
        used = self.used > 0
        mean = float(np.mean(deviation**2))
        s2 = float(np.mean(known[used] ** 2)) / mean
        correlation = np.mean([self.bell(length) for length in TUNING.lengths], axis=0)
        covariance = deviation[:, None] * correlation * deviation
        w = self.w[used]
        across = covariance @ w.T
        return across, w @ across + np.diag(self.variance[used] / s2 + TUNING.model_error * mean)

    def closed(self, deviation: Doubles, start: Doubles) -> Doubles:
        """max(0, x_p + C W^T (W C W^T + V)^-1 (y - W x_p))."""
        known = self.y - self.w @ start
        across, system = self.system(deviation, known)
        found: Doubles = start + across @ np.linalg.solve(system, known[self.used > 0])
        return np.maximum(found, 0)


def relative(found: Floats, wanted: Doubles) -> float:
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


@pytest.mark.parametrize(
    ("kind", "mask", "form"),
    [
        *[(kind, holes(), form) for kind in KINDS for form in (INVERSE, GRADIENTS)],
        *[("sbhe", mask, form) for mask in (WHOLE, LINE) for form in CLOSE],
        *[("sbhe", mask, COMPILED) for mask in (holes(), LINE.T)],
    ],
)
def test_each_round_is_the_closed_form(kind: str, mask: Mask, form: str) -> None:
    """With equal deviations from nothing, those of the first estimate, those of a prediction.

    The last round ends with a step along the weighted residual, as long as the largest eigenvalue
    of Phi Phi^T allows, whatever Phi is.
    """
    if form == COMPILED:
        pytest.importorskip("numba")
    setting, close = Setting(kind, mask, form), CLOSE[form]
    model, nothing = setting.model, np.zeros(setting.phi.n)
    setting.begin()
    assert model.rounds_left == TUNING.cold_rounds
    deviation = nothing + 1
    while model.rounds_left > 1:
        model.round()
        assert relative(model.x, setting.closed(deviation, nothing)) < close
        deviation = setting.deviation(model.x.astype(np.float64))
    model.round()
    x = setting.closed(deviation, nothing)
    residual = setting.used / (1 + setting.variance) * (setting.y - setting.w @ x)
    x = np.maximum(x + setting.w.T @ residual / setting.phi.lipschitz, 0)
    assert relative(model.x, x) < 3 * close

    last = np.roll(setting.x, 1) * 0.8
    setting.begin(last, kept=0.5)
    assert model.rounds_left == TUNING.rounds
    model.round()
    assert relative(model.x, setting.closed(setting.deviation(last), 0.5 * last)) < close
    assert (model.left_out is None) == (form != INVERSE)


@pytest.mark.parametrize("kind", KINDS)
def test_left_out_is_the_residual_of_a_solve_without_the_measurement(kind: str) -> None:
    """And as much larger as is stated, as the deviation was fitted to the measurement, too."""
    setting = Setting(kind, holes(), INVERSE)
    setting.begin()
    setting.model.rounds_left = 1  # known in the last round
    setting.model.round()
    found = setting.model.left_out
    assert found is not None
    used = np.flatnonzero(setting.used)
    n, known = setting.phi.n, setting.y.astype(np.float64)
    across, system = setting.system(np.ones(n), known)
    wanted = np.zeros(known.size)
    for place, row in enumerate(used):
        others = np.arange(used.size) != place
        x = across[:, others] @ np.linalg.solve(system[np.ix_(others, others)], known[used[others]])
        wanted[row] = known[row] - setting.w[row] @ x
    wanted *= math.sqrt(1 + TUNING.fitted / used.size)
    np.testing.assert_allclose(found, wanted, atol=1e-4 * np.abs(wanted).max())
    assert np.abs(found[used]).min() > 0


def test_a_long_strip_is_estimated_as_with_a_dense_correlation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mask = np.ones((1, MOST_DENSE + 40), dtype=np.bool_)
    found = []
    for most in (MOST_DENSE, 2 * MOST_DENSE):
        monkeypatch.setattr(smooth, "MOST_DENSE", most)
        setting = Setting("sbhe", mask, GRADIENTS)
        setting.begin()
        while setting.model.rounds_left:
            setting.model.round()
        found.append(setting.model.x)
    assert relative(found[0], found[1].astype(np.float64)) < 2e-3


def test_a_strip_of_20000_taxels_takes_little_memory() -> None:
    """A dense correlation alone would take 1.6 GB, and three are used."""
    n = 20_000
    phi = make_phi("sbhe", n, n // 8, seed=0)
    projection = make_projection(phi)
    y = np.zeros(projection.n_rows, dtype=np.float32)
    projection.rows_of(np.ones(phi.m, dtype=np.float32), y)
    tracemalloc.start()
    try:
        model = SmoothModel(projection, projection.order, np.ones((1, n), dtype=np.bool_))
        model.setup(0 * y, y, 0 * y + 1, projection.measured, power=1.0, cold=True, kept=1.0)
        model.round()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 40e6
