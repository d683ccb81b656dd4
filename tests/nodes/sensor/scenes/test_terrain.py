"""The cells under a body that can tilt about both axes."""

import numpy as np
import pytest

from sparseskin.nodes.sensor.scenes.bodies import wooden_cube
from sparseskin.nodes.sensor.scenes.scenes import SKIN, TAXEL_RADIUS_M
from sparseskin.nodes.sensor.scenes.terrain import Terrain


@pytest.mark.parametrize(("axis", "sign"), [("pitch", -1.0), ("roll", 1.0)])
def test_a_tilt_lifts_one_side_of_the_body_and_lowers_the_other(axis, sign):
    yaw_rad = 0.7
    sole = wooden_cube(TAXEL_RADIUS_M).sole
    terrain = Terrain(SKIN, (40, 40), sole, yaw_rad, ("z", "pitch", "roll"))
    bed, taxels = terrain.under((0.01, -0.02))
    rows, cols = np.divmod(taxels, 40)
    x = (cols - 19.5) * SKIN.pitch_m - 0.01
    y = (rows - 19.5) * SKIN.pitch_m + 0.02
    along, across = (x, y) if axis == "pitch" else (y, -x)
    place = np.cos(yaw_rad) * along + np.sin(yaw_rad) * across
    column = bed.jacobian[:, 1 if axis == "pitch" else 2]
    np.testing.assert_allclose(column, sign * place, atol=1e-12)
    np.testing.assert_array_equal(bed.jacobian[:, 0], 1.0)
