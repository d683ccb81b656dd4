"""Any grid of taxels."""

import numpy as np
from hypothesis import strategies as st

from sparseskin.nodes.numerics.arrays import Mask


@st.composite
def grids(draw: st.DrawFn) -> Mask:
    """Grids of up to 24 x 24 cells of which some are taxels, one at least."""
    rows, cols = (draw(st.integers(1, 24)) for _ in range(2))
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    exists = rng.random((rows, cols)) < draw(st.sampled_from([0.1, 0.7, 1.0]))
    exists[rng.integers(rows), rng.integers(cols)] = True
    return exists
