"""The smooth model: a Gaussian field as its closed form has it, on any skin and Phi."""

from __future__ import annotations

import math
import tracemalloc
from importlib.util import find_spec

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.base import RANDOM, make_phi
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask
from sparseskin.nodes.reconstructor.skin import smooth
from sparseskin.nodes.reconstructor.skin.smooth import MOST_DENSE, NEGLIGIBLE, SmoothModel
from sparseskin.nodes.reconstructor.skin.tuning import TUNING
from sparseskin.nodes.reconstructor.solvers.projection import (
    PlainProjection,
    SbheProjection,
    make_projection,
)

KINDS = ["sbhe", "gaussian", "subsample", "full"]
#: Relative deviations from the closed form: of the inverse, and of conjugate gradients.
CLOSE = {True: 1e-4, False: 1e-3}
needs_numba = pytest.mark.skipif(find_spec("numba") is None, reason="numba is not installed")


WHOLE = np.ones((8, 8), dtype=np.bool_)


def holes() -> Mask:
    mask = np.ones((8, 8), dtype=np.bool_)
    mask[0, :3] = False
    mask[4, 4] = False
    return mask


class Setting:
    """A skin and measurements of a smooth press, with W, places and K in float64."""

    def __init__(
        self, kind: str, mask: Mask, direct: bool, ratio: int = 3, compiled: bool = False
    ) -> None:
        n = int(mask.sum())
        # Rows without the sums of large blocks, along which a smooth press has most of its energy:
        # conjugate gradients that end at a part of the right side then leave more of the rest.
        self.phi = make_phi(kind, n, n if kind == "full" else n // ratio, 0, 32, RANDOM)
        self.projection = make_projection(self.phi, compiled)
        order = self.projection.order
        cells = np.flatnonzero(mask)[order]
        self.model = self.made(cells, mask, direct)
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

    def made(self, cells: Indices, mask: Mask, direct: bool) -> SmoothModel:
        if isinstance(self.projection, SbheProjection | PlainProjection):
            return SmoothModel(self.projection, cells, mask, direct=direct)
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


@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("mask", [WHOLE, np.ones((1, 40), np.bool_), holes()])
@pytest.mark.parametrize("kind", KINDS)
def test_the_first_round_from_nothing_is_the_closed_form_with_equal_deviations(
    kind: str, mask: Mask, direct: bool
) -> None:
    setting = Setting(kind, mask, direct)
    setting.begin()
    assert setting.model.rounds_left == TUNING.cold_rounds
    setting.model.round()
    n = setting.phi.n
    assert relative(setting.model.x, setting.closed(np.ones(n), np.zeros(n))) < CLOSE[direct]


@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_a_predicted_frame_is_the_closed_form_with_the_deviations_of_the_prediction(
    kind: str, direct: bool
) -> None:
    setting = Setting(kind, holes(), direct)
    last = np.roll(setting.x, 1) * 0.8
    setting.begin(last, kept=0.5)
    assert setting.model.rounds_left == TUNING.rounds
    setting.model.round()
    wanted = setting.closed(setting.deviation(last), 0.5 * last)
    assert relative(setting.model.x, wanted) < CLOSE[direct]


@pytest.mark.parametrize("direct", [True, False])
def test_a_second_round_has_the_deviations_of_the_first_estimate(direct: bool) -> None:
    setting = Setting("sbhe", WHOLE, direct)
    setting.begin()
    setting.model.round()
    deviation = setting.deviation(setting.model.x.astype(np.float64))
    setting.model.round()
    wanted = setting.closed(deviation, np.zeros(setting.phi.n))
    assert relative(setting.model.x, wanted) < CLOSE[direct]


@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_the_last_round_ends_with_a_step_along_the_weighted_residual(
    kind: str, direct: bool
) -> None:
    """The step is as long as the largest eigenvalue of Phi Phi^T allows, whatever Phi is."""
    setting = Setting(kind, WHOLE, direct)
    setting.begin()
    for _ in range(TUNING.cold_rounds - 1):
        setting.model.round()
    deviation = setting.deviation(setting.model.x.astype(np.float64))
    setting.model.round()
    assert setting.model.rounds_left == 0
    x = setting.closed(deviation, np.zeros(setting.phi.n))
    residual = setting.used / (1 + setting.variance) * (setting.y - setting.w @ x)
    x = np.maximum(x + setting.w.T @ residual / setting.phi.lipschitz, 0)
    assert relative(setting.model.x, x) < 3 * CLOSE[direct]


@pytest.mark.parametrize("kind", KINDS)
def test_left_out_is_the_residual_of_a_solve_without_the_measurement(kind: str) -> None:
    """And as much larger as is stated, as the deviation was fitted to the measurement, too."""
    setting = Setting(kind, holes(), direct=True)
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


def test_conjugate_gradients_leave_no_measurement_out() -> None:
    setting = Setting("sbhe", holes(), direct=False)
    setting.begin()
    setting.model.round()
    assert setting.model.left_out is None


@needs_numba
@pytest.mark.parametrize("mask", [WHOLE, np.ones((1, 40), np.bool_), holes()])
def test_compiled_loops_find_the_closed_form_too(mask: Mask) -> None:
    setting = Setting("sbhe", mask, direct=False, compiled=True)
    n = setting.phi.n
    setting.begin()
    setting.model.round()
    x = setting.model.x.astype(np.float64)
    assert relative(setting.model.x, setting.closed(np.ones(n), np.zeros(n))) < CLOSE[False]
    setting.model.round()
    wanted = setting.closed(setting.deviation(x), np.zeros(n))
    assert relative(setting.model.x, wanted) < CLOSE[False]
    last = np.roll(setting.x, 1) * 0.8
    setting.begin(last, kept=0.5)
    setting.model.round()
    wanted = setting.closed(setting.deviation(last), 0.5 * last)
    assert relative(setting.model.x, wanted) < CLOSE[False]


@needs_numba
@pytest.mark.parametrize("shape", [(64, 64), (1, 40), (70, 3), (21, 1)])
def test_the_filters_of_compiled_loops_are_gaussians_to_rounding(shape: tuple[int, int]) -> None:
    from sparseskin.nodes.numerics.kernels import filter_image
    from sparseskin.nodes.reconstructor.skin.fast import CompiledSmoothModel

    model = Setting("sbhe", np.ones(shape, np.bool_), direct=False, compiled=True).model
    assert isinstance(model, CompiledSmoothModel)
    given = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    image, half, total = model._images
    image[model._places] = given.reshape(-1)[model._taxels]
    filter_image(image, half, total, model._layout, *model._filters)
    found, wanted = np.zeros(shape), np.zeros(shape)
    found.reshape(-1)[model._taxels] = total[model._places]
    for length in TUNING.lengths:
        down, right = (smooth._gaussian(side, length).astype(np.float64) for side in shape)
        wanted += down @ given @ right / len(TUNING.lengths)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=5e-7 * np.abs(wanted).max())


@pytest.mark.parametrize("length", TUNING.lengths)
def test_no_product_of_correlations_is_subnormal_which_would_take_forty_times_as_long(
    length: float,
) -> None:
    weights = smooth._gaussian(MOST_DENSE, length)
    assert weights[weights > 0].min() ** 2 >= np.finfo(np.float32).tiny


@pytest.mark.parametrize("length", TUNING.lengths)
def test_the_correlation_of_a_long_line_is_the_dense_one_up_to_its_cut(
    length: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    n = MOST_DENSE + 40
    found = smooth._gaussian(n, length)
    distance = np.abs(np.arange(n)[:, None] - np.arange(n))
    monkeypatch.setattr(smooth, "MOST_DENSE", n)
    dense = smooth._gaussian(n, length)
    near = distance <= NEGLIGIBLE * length
    np.testing.assert_allclose(found.toarray()[near], dense[near], rtol=1e-6)
    np.testing.assert_array_equal(found.toarray()[distance > NEGLIGIBLE * length + 1], 0)
    assert np.abs(dense[~near]).max() <= math.exp(-0.5 * NEGLIGIBLE**2)


def test_a_long_strip_is_estimated_as_with_a_dense_correlation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mask = np.ones((1, MOST_DENSE + 40), dtype=np.bool_)
    found = []
    for most in (MOST_DENSE, 2 * MOST_DENSE):
        monkeypatch.setattr(smooth, "MOST_DENSE", most)
        setting = Setting("sbhe", mask, direct=False)
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
