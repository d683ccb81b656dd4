"""Sums within rows as an array with voltage dividers and crosstalk would read them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.divider import divided, undivided, with_crosstalk
from sparseskin.nodes.compressor.phi.row_local import RowLocalPhi
from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.studies.evaluate import Method, Solved

LOAD_N = 40.0
"""Load of a row line: the conductance of taxels that bear so much together, newtons. Chosen: 16
taxels at full scale."""
ADC_BITS = 12


class ReadRows:
    """Estimator of a method with phi "row_local", whose sums are read by a stated circuit.

    Parameters
    ----------
    method : Method
    divider : "none", "ignored" or "undone"
        Without one, sums are exact. With one, the output is converted by 12 bits of the supply; the
        host takes it as linear (its gain at small forces), or undoes it by the reading of all
        columns.
    crosstalk : float
        Share of a taxel's signal in the readings of its neighbours in the row.
    """

    def __init__(self, method: Method, divider: str = "none", crosstalk: float = 0.0) -> None:
        self._method, self._divider, self._crosstalk = method, divider, crosstalk

    def reconstruct(self, taxels: Floats) -> Solved:
        """Measure and reconstruct a frame; see `Estimator`."""
        phi: Any = self._method.phi
        assert isinstance(phi, RowLocalPhi)
        return self._method.solve(self._measured(phi, taxels.astype(np.float64)))

    def _measured(self, phi: RowLocalPhi, taxels: Doubles) -> Floats:
        n_rows, n_cols = phi.shape
        forces = with_crosstalk(taxels.reshape(n_rows, n_cols), self._crosstalk)
        driven = (phi.patterns > 0).astype(np.float64) @ forces.T  # patterns x rows
        if self._divider != "none":
            steps = 2**ADC_BITS - 1
            v = np.rint(divided(driven, driven[0], LOAD_N) * steps) / steps
            driven = undivided(v, v[0], LOAD_N) if self._divider == "undone" else v * LOAD_N
        y = np.concatenate([driven[:1], 2 * driven[1:] - driven[:1]]) / math.sqrt(n_cols)
        return y.reshape(-1)[phi.rows].astype(np.float32)
