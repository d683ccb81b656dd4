"""The iterations of the Haar model as one kernel: a program of the GPU for each patch."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Indices
from sparseskin.nodes.reconstructor.skin.solver import N_DRAWN, TUNING

from .backend import Array
from .state import State
from .tables import Tables

#: Places of a vector, at most and at least: a patch has to fit into one multiprocessor, and
#: matrix products have sides of 16 or more.
MOST_PLACES, LEAST_PLACES = 16384, 1024


def fits(t: Tables) -> bool:
    """True if the kernel can be used: Triton is installed, and a patch fits into it."""
    n_places = _places(t)
    return (
        find_spec("triton") is not None
        and t.whole_blocks
        and t.block >= 16
        and LEAST_PLACES <= n_places <= MOST_PLACES
    )


def _places(t: Tables) -> int:
    return 1 << (max(t.n_canvas, t.n) - 1).bit_length()


class FusedIterations:
    """As `haar.estimate`, on a GPU and without a wait of the host.

    Each patch does its own number of iterations, its vectors being kept on the multiprocessor.
    Vectors are filled up with zeros to a power of two.

    Parameters
    ----------
    t : Tables
        Of a backend of torch.
    n_warps : int
        Groups of 32 threads of a patch.
    precision : str
        Of the matrix products, as `triton.language.dot` takes it: "ieee", or "tf32x3", with which
        the left side is split into three parts. The right sides, +-1 and 0, are exact.
    """

    def __init__(self, t: Tables, n_warps: int = 8, precision: str = "tf32x3") -> None:
        from .kernel import iterate

        self._kernel, self._n_warps, self._precision = iterate, n_warps, precision
        self._t, be = t, t.be
        n_places = self._n_places = _places(t)

        def padded(table: Array) -> Array:
            known: Indices = be.numpy(table)
            filled = np.full((len(known), n_places), min(t.n, n_places - 1), dtype=np.int32)
            filled[:, : known.shape[1]] = known
            return be.array(filled)

        self._to_canvas, self._from_canvas = padded(t.to_canvas), padded(t.from_canvas)
        self._shifts = be.array(be.numpy(t.shifts).astype(np.int32))
        # Signs are exact in every precision; scales follow.
        self._signs = be.array(np.sign(be.numpy(t.hadamard)).astype(np.float32))
        haar = be.numpy(t.haar)
        norms = np.abs(haar).max(axis=1)
        self._steps = be.array(np.sign(haar).astype(np.float32))
        self._steps_adjoint = be.array(np.ascontiguousarray(np.sign(haar).T, dtype=np.float32))
        self._norms = be.array(norms.astype(np.float32))

    def estimate(self, frame: State) -> Array:
        """Return the estimate by the Haar model, float32 (B, n); frame is as of `begin`."""
        t, be, xp = self._t, self._t.be, self._t.be.xp
        x = frame["x"]
        out = xp.empty_like(x)

        def whole(a: Array) -> Any:
            return xp.astype(a, xp.int32)

        self._kernel[(x.shape[0],)](
            *(x, frame["target"], frame["weights"], out),
            *(self._signs, self._steps, self._steps_adjoint, self._norms),
            *(self._to_canvas, self._from_canvas, self._shifts),
            *(whole(frame["next_shift"]), whole(frame["n_haar"])),
            *(be.single(frame["threshold"]), be.single(frame["least"])),
            t.n,
            PLACES=self._n_places,
            BLOCK=t.block,
            SCALE=t.block**-0.5,
            MOMENTUM=TUNING.momentum,
            AVERAGED=TUNING.averaged,
            N_DRAWN=N_DRAWN,
            LEAST2=TINY,
            PRECISION=self._precision,
            num_warps=self._n_warps,
            num_stages=1,
        )
        return out
