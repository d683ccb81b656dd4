"""Noise around 0 is noticed once, with the remedy; other skins get no notice."""

from __future__ import annotations

import re

import numpy as np
import pytest

from sparseskin.nodes.sensor.calibration.zero import WATCHED_FRAMES, ZeroWatch, lower_end

RNG = np.random.default_rng(5)


def notices(frames: np.ndarray) -> list[str]:
    watch = ZeroWatch(2.5, 0.0)
    return [line for frame in frames if (line := watch.add(frame))]


NOISE = RNG.normal(0, 0.0125, (3 * WATCHED_FRAMES, 64))


def test_noise_around_0_is_noticed_once_with_a_lower_end_of_four_standard_deviations() -> None:
    (line,) = notices(NOISE)
    # Of 6400 readings the half below 0 has a standard deviation of 0.6 %, their size one of 1.3 %.
    assert re.search(r"\b(48|49|50|51|52) % of the untouched readings are below 0", line)
    found = re.search(r"f_min = (\S+) keeps them", line)
    assert found is not None
    assert float(found[1]) == pytest.approx(-4 * 0.0125, rel=0.06)


def test_pressed_taxels_do_not_count() -> None:
    frames = NOISE.copy()
    frames[:, :48] += 1.0
    assert re.search(r"\b(46|47|48|49|50|51|52|53|54) % of", notices(frames)[0])


def test_a_source_that_clips_its_noise_is_noticed() -> None:
    (line,) = notices(np.clip(NOISE, 0, None))
    assert "are 0, the source clips them" in line


@pytest.mark.parametrize(
    "frames", [NOISE + 0.06, np.zeros_like(NOISE), np.round(NOISE + 0.06, 2), NOISE + 1.0]
)
def test_an_offset_and_a_dead_band_are_not(frames: np.ndarray) -> None:
    assert notices(frames) == []


def test_the_lower_end_has_two_digits() -> None:
    assert lower_end(0.01234) == -0.049
    assert lower_end(0.0) == 0.0
