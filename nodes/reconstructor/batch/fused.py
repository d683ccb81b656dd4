"""Iterations of the Haar model, and the smooth model, as one kernel each: a program a patch."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Indices
from sparseskin.nodes.reconstructor.skin.solver import N_DRAWN
from sparseskin.nodes.reconstructor.skin.tuning import TUNING

from .backend import Array
from .smooth import Known, SmoothBatch
from .state import State
from .tables import Tables

#: Places of a vector, at most and at least: a patch has to fit into one multiprocessor, and
#: matrix products have sides of 16 or more.
MOST_PLACES, LEAST_PLACES = 16384, 1024


def fits(t: Tables) -> bool:
    """True if the kernel can be used: Triton is installed, and a patch fits into it."""
    n_places = max(_places(t), _power_of_2(t.shape[0]) * _power_of_2(t.shape[1]))
    return (
        find_spec("triton") is not None
        and t.whole_blocks
        and t.block >= 16
        and min(t.shape) >= 16
        and LEAST_PLACES <= n_places <= MOST_PLACES
    )


def _power_of_2(n: int) -> int:
    return 1 << (n - 1).bit_length()


def _places(t: Tables) -> int:
    return _power_of_2(max(t.n_canvas, t.n))


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

    def __init__(self, t: Tables, n_warps: int = 4, precision: str = "tf32x3") -> None:
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
        x = frame["haar_start"]
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


class FusedSmooth:
    """As `SmoothBatch.estimate_some`, on a GPU and without a wait of the host.

    Patches that need no estimate cost next to nothing. Sums are float32.

    Parameters
    ----------
    smooth : SmoothBatch
        Of a backend of torch.
    n_warps, precision
        As in `FusedIterations`; the Gaussians are rounded in parts, too.
    """

    def __init__(self, smooth: SmoothBatch, n_warps: int = 16, precision: str = "ieee") -> None:
        from .kernel_smooth import estimate

        self._kernel, self._n_warps, self._precision = estimate, n_warps, precision
        t = self._t = smooth.t
        be, (n_rows, n_cols) = t.be, t.shape
        height, width = _power_of_2(n_rows), _power_of_2(n_cols)
        self._sides = height, width
        self._n_places = max(_power_of_2(t.n), height * width)

        def padded(a: Array, *shape: int) -> Array:
            given = be.numpy(a).astype(np.float32)
            filled = np.zeros(shape, dtype=np.float32)
            filled[tuple(slice(side) for side in given.shape)] = given
            return be.array(filled)

        lengths = smooth.left.shape[0]
        self._lengths = lengths
        self._lefts = padded(smooth.left, lengths, height, height)
        self._rights = padded(smooth.right, lengths, width, width)
        self._blurs = (
            padded(smooth.blur[0][0, ...], height, height),
            padded(smooth.blur[1][0, ...], width, width),
        )
        neighbours = np.ones((height, width), dtype=np.float32)
        neighbours[:n_rows, :n_cols] = be.numpy(smooth.neighbours)[0]
        self._neighbours = be.array(neighbours)
        self._exists = padded(t.exists, height, width)
        self._signs = be.array(np.sign(be.numpy(t.hadamard)).astype(np.float32))
        rows, cols = np.divmod(be.numpy(t.cells), n_cols)
        from_image = np.full(self._n_places, -1, dtype=np.int32)
        from_image[: t.n] = rows * width + cols
        to_image = np.full(self._n_places, self._n_places - 1, dtype=np.int32)
        to_image[from_image[: t.n]] = np.arange(t.n)
        self._from_image, self._to_image = be.array(from_image), be.array(to_image)

    def estimate(self, known: Known, needed: Array, cold: Array) -> Array:
        """Return the estimates of the patches that need one, float32 (B, n), of others 0."""
        t, be, xp = self._t, self._t.be, self._t.be.xp
        out = xp.empty_like(known.x)
        self._kernel[(known.x.shape[0],)](
            *(known.x, known.values, known.variance, known.used, out),
            *(xp.astype(needed, xp.int32), xp.astype(cold, xp.int32)),
            *(be.single(known.power), be.single(known.kept)),
            *(self._signs, self._lefts, self._rights, *self._blurs),
            *(self._neighbours, self._exists, self._to_image, self._from_image),
            t.n,
            PLACES=self._n_places,
            N_ROWS=self._sides[0],
            N_COLS=self._sides[1],
            BLOCK=t.block,
            SCALE=t.block**-0.5,
            LENGTHS=self._lengths,
            ROUNDS=TUNING.rounds,
            COLD_ROUNDS=TUNING.cold_rounds,
            GRADIENTS=TUNING.gradients,
            COLD_GRADIENTS=TUNING.cold_gradients,
            FLOOR=TUNING.deviation_floor,
            MODEL_ERROR=TUNING.model_error,
            PRECISE=TUNING.precise,
            TINY=TINY,
            PRECISION=self._precision,
            num_warps=self._n_warps,
            num_stages=1,
        )
        return out
