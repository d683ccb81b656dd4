"""Prediction: what slides and grows is followed, noise is not."""

from __future__ import annotations

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.skin.prediction import Prediction, neighbours_of
from sparseskin.nodes.reconstructor.solvers.projection import make_projection

SIDE, N, M = 32, 1024, 341
NOISE_N = 0.01


class Setting:
    """A prediction for 32 x 32 taxels, and images to and from its order of taxels."""

    def __init__(self, m: int = M) -> None:
        self.projection = make_projection(make_phi("sbhe", N, m, seed=0))
        place_of_cell = np.empty(N, dtype=np.intp)
        place_of_cell[self.projection.order] = np.arange(N)
        neighbours = neighbours_of(place_of_cell.reshape(SIDE, SIDE), N)
        self.prediction = Prediction(self.projection, neighbours, N, m)
        self.innovation = np.zeros(self.projection.n_rows, dtype=np.float32)

    def vector(self, image: Floats) -> Floats:
        return image.reshape(-1)[self.projection.order].copy()

    def predict(self, last: Floats, now: Floats, noise: int = 0) -> tuple[Floats, float]:
        """Predict image `now` from image `last`; the prediction as an image, mean innovation."""
        rng = np.random.default_rng(noise)
        read = self.vector(now) + rng.normal(0, NOISE_N, N).astype(np.float32)
        y = np.zeros((1, self.projection.n_rows), dtype=np.float32)
        self.projection.forward(read[None], y)
        x = self.vector(last)
        e2 = self.prediction.predict(x, y[0], self.innovation, NOISE_N**2)
        image = np.empty(N, dtype=np.float32)
        image[self.projection.order] = x
        return image.reshape(SIDE, SIDE), e2


def bump(row: float, col: float, peak_n: float = 1.0) -> Floats:
    rows, cols = np.indices((SIDE, SIDE))
    distance2 = (rows - row) ** 2 + (cols - col) ** 2
    return (peak_n * np.exp(-distance2 / 18)).astype(np.float32)


@pytest.mark.parametrize(
    "now", [bump(16.3, 16), bump(16, 15.6), bump(16, 16, 1.2), bump(15.8, 16.2, 0.9)]
)
def test_a_contact_that_slides_or_grows_is_followed(now: Floats) -> None:
    last = bump(16, 16)
    predicted, _ = Setting().predict(last, now)
    assert np.linalg.norm(predicted - now) < 0.25 * np.linalg.norm(last - now)


def test_a_still_scene_is_not_moved_by_noise() -> None:
    still = (bump(16, 16) > 0.5).astype(np.float32)
    moved = [not np.array_equal(Setting().predict(still, still, k)[0], still) for k in range(40)]
    assert sum(moved) <= 3


def test_the_innovation_is_that_of_the_prediction() -> None:
    setting = Setting()
    last, now = bump(16, 16), bump(16.4, 16)
    predicted, e2 = setting.predict(last, now)
    assert e2 == pytest.approx(float(setting.innovation @ setting.innovation), rel=1e-5)
    through = np.zeros((1, setting.projection.n_rows), dtype=np.float32)
    setting.projection.forward(setting.vector(now - predicted)[None], through)
    assert float(np.mean((through[0] - setting.innovation) ** 2)) < 2 * NOISE_N**2 * M / N


def test_a_contact_that_vanished_while_another_came_predicts_nothing() -> None:
    setting = Setting()
    predicted, _ = setting.predict(bump(8, 8), bump(24, 24))
    assert setting.prediction.failed
    np.testing.assert_array_equal(predicted, 0)
    setting.predict(bump(8, 8), bump(8, 8.2))
    assert not setting.prediction.failed


def test_what_no_measurement_sees_does_not_grow_beyond_the_largest_force() -> None:
    projection = make_projection(make_phi("subsample", N, 128, seed=0))
    place = np.arange(N).reshape(SIDE, SIDE)
    prediction = Prediction(projection, neighbours_of(place, N), N, 128)
    x = bump(16, 16).ravel()
    target = (5 * bump(17, 16)).ravel()
    y = np.zeros((1, 128), dtype=np.float32)
    projection.forward(target[None], y)
    innovation = np.zeros(128, dtype=np.float32)
    largest = x.max()
    prediction.predict(x, y[0], innovation, 1e-6)
    assert x.min() >= 0
    assert x.max() <= 5.5 * largest
