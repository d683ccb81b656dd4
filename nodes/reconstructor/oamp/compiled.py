"""The steps of a frame as one compiled loop, on vectors in the order of `HadamardRows`."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.numerics.compiled import ready
from sparseskin.nodes.numerics.kernels import gated_step

from .gates import CLEARLY, QUIET, STANDS_OUT, TILE, WINDOW, Gates, Tiles
from .rows import HadamardRows


class CompiledStep:
    """A step of a frame, the same as in numpy but for rounding.

    Parameters
    ----------
    rows, tiles, gates
        Those of the solver; the rows compiled.
    constants : sequence of float
        Least tau, most alpha and damping of `OampTuning`.
    """

    def __init__(
        self, rows: HadamardRows, tiles: Tiles, gates: Gates, constants: tuple[float, float, float]
    ) -> None:
        ready(gated_step)
        self._rows, self._tiles = rows, tiles
        self._numbers = np.array(
            [0.0, 0.0, *constants, gates.error_0[0], QUIET, *STANDS_OUT, CLEARLY, 0.0]
        )
        self._vectors = rows.groups, rows.scale, np.zeros(rows.n + 1, dtype=np.float32)

        def transposed(matrix: Floats) -> Floats:
            return np.ascontiguousarray(matrix.T)

        self._weights = (
            *(transposed(gates.filters), transposed(gates.hidden), gates.hidden_0),
            *(transposed(gates.gates), gates.gates_0, transposed(gates.synthesis), gates.error[0]),
        )
        k, h = len(gates.filters), len(gates.hidden_0)
        widths = (WINDOW * WINDOW, k, 2 * k, h, k + 1, TILE * TILE, TILE * TILE)
        self._scratch = [
            *(np.zeros((tiles.most, width), dtype=np.float32) for width in widths),
            np.zeros(tiles.most, dtype=np.float32),
            np.zeros(tiles.most, dtype=np.intp),
        ]

    def __call__(
        self,
        z: Floats,
        target: Floats,
        variance: Floats,
        noise: float,
        floor: float,
        off_target: Floats,
        shift: int,
    ) -> tuple[Floats, float, float]:
        """Change z, float32 (n,), to that of the next step; return x, its squared error, and the
        mean squared residual of z.

        target and variance are those of the rows, float32 (n,), noise the mean variance of the
        rows read, floor the least variance; off_target, float32 (m,): what the values of the rows
        read exceed their target by; shift: as of `Tiles.tables`.
        """
        x = np.empty_like(z)
        self._numbers[:2] = noise, floor
        error2 = gated_step(
            *(z, x, target, variance, self._rows.read, off_target, *self._vectors),
            *(*self._tiles.tables(shift), *self._weights, self._numbers, *self._scratch),
        )
        return x, error2, float(self._numbers[-1])
