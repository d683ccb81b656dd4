"""Rotating rows: each row subset is a matrix of its own; together they hold every row."""

import numpy as np
import pytest

from sparseskin.checks import check_phi
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.errors import PhiError


@pytest.mark.parametrize("kind", ["sbhe", "subsample"])
@pytest.mark.parametrize("ratio", [1, 5])
def test_together_the_row_subsets_hold_each_row_of_w_once(kind, ratio):
    n = 240
    subsets = row_subsets(make_phi(kind, n, n // ratio, seed=1), "rotating")
    rows = np.concatenate([phi.rows for phi in subsets])
    np.testing.assert_array_equal(np.sort(rows), np.arange(n))
    for phi in subsets:
        check_phi(phi)
    whole = np.concatenate([phi.dense() for phi in subsets])
    np.testing.assert_allclose(whole @ whole.T, np.eye(n), atol=1e-12)


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        ({}, ("rotating", 534)),
        ({"ratio": 4.0}, ("rotating", 400)),
        ({"phi": "subsample"}, ("rotating", 534)),
        ({"phi": "row_local"}, ("rotating", 534)),
        # No row is left to rotate to.
        ({"m": 1600}, ("fixed", 1600)),
        # 64 row subsets are allowed.
        ({"m": 25}, ("rotating", 25)),
        ({"m": 24}, ("fixed", 24)),
        # Their rows do not rotate.
        ({"phi": "gaussian"}, ("fixed", 533)),
        ({"phi": "adaptive"}, ("fixed", 533)),
        ({"phi": f"{__name__}:Halves"}, ("rotating", 534)),
        ({"phi": f"{__name__}:Unmoved"}, ("fixed", 533)),
        ({"phi": f"{__name__}:by_function"}, ("fixed", 533)),
        # What is stated stays.
        ({"rows": "fixed"}, ("fixed", 533)),
        ({"rows": "rotating", "m": 1600}, ("rotating", 1600)),
    ],
)
def test_rows_rotate_by_default_where_they_can(stated, expected):
    assert CompressorSettings(**stated).rows_and_m(1600) == expected


class Halves(SbhePhi):
    """A matrix of the user's own whose rows rotate."""

    kind = f"{__name__}:Halves"


class Unmoved(Phi):
    """One whose rows do not."""

    kind = f"{__name__}:Unmoved"


def by_function(n, m, seed, block):
    """One that a function makes."""
    return make_phi("sbhe", n, m, seed, block)


def test_what_cannot_rotate_is_named():
    for kind in ("gaussian", "full", "acts"):
        with pytest.raises(PhiError, match=f'rows: "rotating" is not allowed for phi "{kind}"'):
            CompressorSettings(phi=kind, rows="rotating").check()
        with pytest.raises(PhiError, match="allowed: sbhe, subsample"):
            row_subsets(make_phi(kind, 64, 64, seed=0), "rotating")
    with pytest.raises(PhiError, match="rows: 'turning' is not allowed; allowed: fixed, rotating"):
        row_subsets(make_phi("sbhe", 64, 16, seed=0), "turning")
    with pytest.raises(PhiError, match=r"m = 24 of n = 1600; allowed: m of 25 or more \(N/64\)"):
        row_subsets(make_phi("sbhe", 1600, 24, seed=0), "rotating")
