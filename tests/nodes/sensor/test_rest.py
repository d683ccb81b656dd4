"""A level at rest is noticed, and nothing else is taken for one."""

import numpy as np
import pytest

from sparseskin.messages.skin import Skin
from sparseskin.nodes.sensor.rest import Rest

SKIN = Skin(10, 10, f_max=2.5)


@pytest.mark.parametrize(
    ("level", "n_lifted", "found"), [(0.3, 100, True), (0.3, 80, False), (0.0, 100, False)]
)
def test_what_nearly_all_taxels_read_at_first_is_named_with_its_remedy(level, n_lifted, found):
    rng, rest = np.random.default_rng(0), Rest(SKIN)
    told = []
    for _ in range(60):
        frame = rng.normal(0, 0.02, 100)
        frame[:n_lifted] += level
        told.append(rest.update(frame.clip(0).astype(np.float32).reshape(SKIN.shape)))
    assert sum(told) == found
    assert ("sensor.tare=30" in rest.line) == found
