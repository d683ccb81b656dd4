"""Settings of the sensor: the numbers that each allows."""

import math

import pytest

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.sensor.settings import SensorSettings

RANGES = [
    ("rate_hz", 0.0, 100_000.0),
    ("first", 0, 2**31 - 1),
    ("every", 1, 2**31 - 1),
    ("seed", 0, 2**32 - 1),
    ("noise", 0.0, 100.0),
    ("tare", 0, 10_000),
    ("drift", 0.0, 1.0),
    ("f_min", -1e9, 0.0),
]


def settings(name, value):
    """Settings of a scene, or of a driver of raw readings."""
    source = "scene:path_40"
    if name in ("tare", "drift", "f_min"):
        source = "glove:frames"
    return SensorSettings(source=source, **{name: value})


@pytest.mark.parametrize(("name", "low", "high"), RANGES)
def test_a_number_may_be_the_least_and_the_largest_of_its_range(name, low, high):
    for allowed in (low, high):
        assert getattr(settings(name, allowed), name) == allowed


@pytest.mark.parametrize(("name", "low", "high"), RANGES)
def test_a_number_outside_its_range_is_refused(name, low, high):
    below = low - 1
    above = high + 1
    if isinstance(low, float):
        below = math.nextafter(low, -math.inf)
        above = math.nextafter(high, math.inf)
    for refused in (below, above):
        with pytest.raises(SparseskinError, match=name):
            settings(name, refused)
