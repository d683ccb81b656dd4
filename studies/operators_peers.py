"""The operators as other libraries have them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.hadamard import hadamard_matrix
from sparseskin.nodes.compressor.sbhe import SbhePhi
from sparseskin.nodes.reconstructor.haar import HaarBasis

Floats = npt.NDArray[np.float32]
#: By operator, and there by number of frames: what is timed.
Calls = dict[str, dict[int, Callable[[], object]]]

PEERS = {"PyWavelets": "pywt", "scipy.sparse": "scipy", "PyLops": "pylops"}
FORWARD, ADJOINT, ANALYSIS, SYNTHESIS = "Phi", "Phi^T", "Psi^T", "Psi"


def missing_peers() -> list[str]:
    """Libraries that are not installed."""
    return [name for name, module in PEERS.items() if find_spec(module) is None]


def peer_calls(name: str, phi: SbhePhi, basis: HaarBasis, frames: Floats) -> Calls:
    """What a library is timed at, on one frame and on all of them.

    Parameters
    ----------
    name : str
        One of `PEERS`.
    phi, basis
        The operators.
    frames : ndarray of float32, shape (k, n_rows, n_cols)
    """
    made: Mapping[str, Callable[..., Calls]] = {
        "PyWavelets": _pywavelets,
        "scipy.sparse": _sparse,
        "PyLops": _pylops,
    }
    return made[name](phi, basis, frames)


def _depth(basis: HaarBasis) -> int:
    return int(np.floor(np.log2(min(basis.n_rows, basis.n_cols))))


def _pywavelets(phi: SbhePhi, basis: HaarBasis, frames: Floats) -> Calls:
    """Its own 2-D transform; where a side is odd it repeats the last sample, and is longer."""
    import pywt

    options: dict[str, Any] = {"wavelet": "haar", "mode": "periodization"}
    level, k = _depth(basis), len(frames)
    calls: Calls = {ANALYSIS: {}, SYNTHESIS: {}}
    for count, given in ((1, frames[0]), (k, frames)):
        theta = pywt.wavedec2(given, level=level, axes=(-2, -1), **options)
        calls[ANALYSIS][count] = partial(
            pywt.wavedec2, given, level=level, axes=(-2, -1), **options
        )
        calls[SYNTHESIS][count] = partial(pywt.waverec2, theta, axes=(-2, -1), **options)
    return calls


def _sparse(phi: SbhePhi, basis: HaarBasis, frames: Floats) -> Calls:
    """Compressed rows of the very same matrices."""
    forward, analysis = sparse_phi(phi), _sparse_analysis(basis)
    matrices = {
        FORWARD: forward,
        ADJOINT: forward.T.tocsr(),
        ANALYSIS: analysis,
        SYNTHESIS: analysis.T.tocsr(),
    }
    calls: Calls = {}
    k = len(frames)
    for operator, matrix in matrices.items():
        x = np.random.default_rng(0).standard_normal((matrix.shape[1], k)).astype(np.float32)
        calls[operator] = {
            1: partial(matrix.__matmul__, np.ascontiguousarray(x[:, 0])),
            k: partial(matrix.__matmul__, x),
        }
    return calls


def sparse_phi(phi: SbhePhi) -> Any:
    """Phi in compressed rows, float32."""
    from scipy import sparse

    blocks = [hadamard_matrix(size) / np.sqrt(size) for size in phi.hadamard.sizes]
    columns = np.argsort(phi.permutation)
    return sparse.block_diag(blocks, format="csr", dtype=np.float32)[phi.rows][:, columns]


def _sparse_analysis(basis: HaarBasis) -> Any:
    from scipy import sparse

    n = basis.n_rows * basis.n_cols
    theta = np.zeros((basis.n_rows, basis.n_cols), dtype=np.float32)
    image = np.empty_like(theta)
    places, values, ends = [], [], [0]
    for k in range(n):
        theta.flat[k] = 1
        basis.synthesis(theta, image)
        theta.flat[k] = 0
        found = np.flatnonzero(image)
        places.append(found)
        values.append(image.reshape(-1)[found])
        ends.append(ends[-1] + found.size)
    data = np.concatenate(values), np.concatenate(places).astype(np.int32), np.array(ends)
    return sparse.csr_matrix(data, shape=(n, n))


def _pylops(phi: SbhePhi, basis: HaarBasis, frames: Floats) -> Calls:
    """Its own 2-D wavelets, and Phi of its restriction and matrix operators."""
    import pylops

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        shape, n, block = (basis.n_rows, basis.n_cols), phi.n, phi.block
        wavelets = pylops.signalprocessing.DWT2D(
            shape, wavelet="haar", level=_depth(basis), dtype="float32"
        )
        whole = n // block
        parts = [
            pylops.MatrixMult(
                (hadamard_matrix(block) / np.sqrt(block)).astype(np.float32), otherdims=(whole,)
            )
        ]
        for size in phi.hadamard.sizes[whole:]:
            matrix = (hadamard_matrix(size) / np.sqrt(size)).astype(np.float32)
            parts.append(pylops.MatrixMult(matrix))
        # MatrixMult works along the first axis: the whole blocks side by side.
        side = np.arange(whole * block).reshape(whole, block).T.ravel()
        columns = np.concatenate([side, np.arange(whole * block, n)])
        rows = np.argsort(columns)[phi.rows]
        dealt = pylops.Restriction(n, phi.permutation[columns], dtype="float32")
        kept = pylops.Restriction(n, rows, dtype="float32")
        forward = kept @ pylops.BlockDiag(parts, dtype="float32") @ dealt
    flat = frames.reshape(len(frames), -1)
    y = np.stack([forward.matvec(x) for x in flat]).astype(np.float32)
    theta = np.stack([wavelets.matvec(x) for x in flat]).astype(np.float32)
    given = {FORWARD: flat, ADJOINT: y, ANALYSIS: flat, SYNTHESIS: theta}
    matvec = {
        FORWARD: forward.matvec,
        ADJOINT: forward.rmatvec,
        ANALYSIS: wavelets.matvec,
        SYNTHESIS: wavelets.rmatvec,
    }
    calls: Calls = {}
    for operator, vectors in given.items():
        apply = matvec[operator]
        calls[operator] = {
            1: partial(apply, vectors[0]),
            len(frames): partial(_each, apply, vectors),
        }
    return calls


def _each(apply: Callable[[Floats], Any], vectors: Floats) -> None:
    for one in vectors:
        apply(one)
