"""Time of Phi and Psi, beside the least that they could take and beside other libraries."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pywt
from scipy import sparse

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis

BATCH, RATIO = 16, 3
OPERATORS = FORWARD, ADJOINT, ANALYSIS, SYNTHESIS = "Phi", "Phi^T", "Psi^T", "Psi"
OURS = "numpy"
#: Duration of a window of calls that are timed together, microseconds. Chosen: shorter than a time
#: slice of the kernel, so that the median is of windows that were not interrupted.
WINDOW_US = 150.0
#: Side of the matrices of the product that measures arithmetic speed.
PRODUCT_SIDE = 256
#: Calls to be timed: of an operator on one frame, and on a batch of them.
Calls = dict[str, tuple[Callable[[], object], Callable[[], object]]]


def median_us(function: Callable[[], object], windows: int) -> float:
    """Median time of a call over short windows of calls, microseconds."""

    def span_us(n_calls: int) -> float:
        begin_ns = time.perf_counter_ns()
        for _ in range(n_calls):
            function()
        return (time.perf_counter_ns() - begin_ns) / 1e3 / n_calls

    function()
    n_calls = max(1, round(WINDOW_US / max(span_us(1), 0.05)))
    return float(np.median([span_us(n_calls) for _ in range(windows)]))


def measured_speeds(n: int, windows: int) -> tuple[float, float]:
    """Best speeds of one core, measured.

    Returns
    -------
    flops_per_us : float
        Sums and products of a float32 matrix product, 256 x 256, in a microsecond.
    bytes_per_us : float
        Bytes read and written by a copy of n float32, in a microsecond.
    """
    a, b, c = (np.ones((PRODUCT_SIDE, PRODUCT_SIDE), dtype=np.float32) for _ in range(3))
    product_us = median_us(lambda: np.dot(a, b, c), windows)
    source, target = np.ones(n, dtype=np.float32), np.ones(n, dtype=np.float32)
    copy_us = median_us(lambda: np.copyto(target, source), windows)
    return 2 * PRODUCT_SIDE**3 / product_us, 8 * n / copy_us


def time_operators(point: dict[str, Any]) -> dict[str, Any]:
    """Time all operators of one size, in all ways, one after the other in one process.

    `point`: side of the skin, seed, windows.

    Returns
    -------
    dict
        rows: a dict for each operator and library, with alone_us and batch_us, the median a frame
        alone and in a batch; least_us, the larger of the times that its sums and products, and its
        input and output, take at the best speeds of the core.
    """
    side, windows = point["side"], point["windows"]
    n = side * side
    phi, basis = make_phi("sbhe", n, n // RATIO, point["seed"]), make_basis("haar", side, side)
    frames = np.random.default_rng(point["seed"]).random((BATCH, side, side), dtype=np.float32)
    flops_per_us, bytes_per_us = measured_speeds(n, windows)
    libraries = {
        OURS: numpy_calls(phi, basis, frames),
        "PyWavelets": pywavelets_calls(frames),
        "scipy.sparse": sparse_calls(phi, basis),
    }
    return {
        "rows": [
            {
                **{"operator": operator, "library": library, "n": n},
                "alone_us": round(median_us(alone, windows), 3),
                "batch_us": round(median_us(together, windows) / BATCH, 3),
                "least_us": round(
                    max(
                        flops_of(operator, n, phi.block) / flops_per_us,
                        4 * (n + n / RATIO if "Phi" in operator else 2 * n) / bytes_per_us,
                    ),
                    3,
                ),
            }
            for library, calls in libraries.items()
            for operator, (alone, together) in calls.items()
        ]
    }


def flops_of(operator: str, n: int, block: int) -> float:
    """Least number of sums, differences and products of an operator.

    Haar: 8 sums for 4 samples at each level, a quarter of which go on; then the scale of each.
    """
    return n * math.log2(block) + n / RATIO if "Phi" in operator else 2 * n * 4 / 3 + n


def numpy_calls(phi: Any, basis: Any, frames: Floats) -> Calls:
    """Calls of the project's own operators."""
    x, thetas = frames.reshape(len(frames), -1), np.empty_like(frames)
    y, back = phi.forward(x), np.empty_like(x)
    return {
        name: (partial(apply, given[0], out[0]), partial(apply, given, out))
        for name, apply, given, out in (
            (FORWARD, phi.forward, x, y),
            (ADJOINT, phi.adjoint, y, back),
            (ANALYSIS, basis.analysis, frames, thetas),
            (SYNTHESIS, basis.synthesis, frames, thetas),
        )
    }


def pywavelets_calls(frames: Floats) -> Calls:
    """Its own 2-D transform; where a side is odd it repeats the last sample, and is longer."""
    depth = int(np.log2(min(frames.shape[1:])))
    options: dict[str, Any] = {"wavelet": "haar", "mode": "periodization", "axes": (-2, -1)}
    analysis, synthesis = (partial(f, **options) for f in (pywt.wavedec2, pywt.waverec2))
    given = (frames[0], frames)
    alone, together = (partial(analysis, one, level=depth) for one in given)
    return {
        ANALYSIS: (alone, together),
        SYNTHESIS: (partial(synthesis, alone()), partial(synthesis, together())),
    }


def sparse_calls(phi: Any, basis: Any) -> Calls:
    """Compressed rows of the very same matrices."""
    forward = sparse.csr_matrix(phi.dense().astype(np.float32))
    atoms, theta = [], np.zeros((basis.n_rows, basis.n_cols), dtype=np.float32)
    for k in range(theta.size):
        theta.flat[k] = 1
        atoms.append(sparse.csr_matrix(basis.synthesis(theta).reshape(1, -1)))
        theta.flat[k] = 0
    analysis = sparse.vstack(atoms, format="csr")
    matrices = (forward, forward.T.tocsr(), analysis, analysis.T.tocsr())
    calls: Calls = {}
    for operator, matrix in zip(OPERATORS, matrices, strict=True):
        x = np.random.default_rng(0).random((matrix.shape[1], BATCH), dtype=np.float32)
        one = np.ascontiguousarray(x[:, 0])
        calls[operator] = (partial(matrix.__matmul__, one), partial(matrix.__matmul__, x))
    return calls
