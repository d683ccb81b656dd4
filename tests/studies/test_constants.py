"""Constants of the default solver left out one at a time, over recordings and scenes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sparseskin.nodes.reconstructor.skin.tuning import TUNING
from sparseskin.nodes.sensor.scenes.presses import press_frames
from sparseskin.studies.targets.constants import LEFT_OUT, Stream, figure


@pytest.mark.parametrize("name", LEFT_OUT)
def test_each_change_changes_a_constant_and_leaves_a_solver_that_works(name: str) -> None:
    tuning = replace(TUNING, **LEFT_OUT[name])
    assert tuning != TUNING
    found = list(press_frames("plate", (18, 18), 13, 0))
    truth, taxels = (np.stack(frames) for frames in zip(*found, strict=True))
    mask = np.ones((18, 18), dtype=np.bool_)
    for loaded in (None, 0.0):
        stream = Stream("plate", taxels, truth, mask, loaded, 2.5)
        assert math.isfinite(figure(stream, 3, "rotating", tuning))
