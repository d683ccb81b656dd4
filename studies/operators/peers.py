"""The operators as other libraries implement them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.phi.hadamard import hadamard_matrix
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis

#: Calls to be timed, by operator and number of frames.
Calls = dict[str, dict[int, Callable[[], object]]]

FORWARD, ADJOINT, ANALYSIS, SYNTHESIS = "Phi", "Phi^T", "Psi^T", "Psi"


def missing_peers() -> list[str]:
    """Names of libraries that are not installed."""
    return [name for name, (module, _) in PEERS.items() if find_spec(module) is None]


def peer_calls(name: str, phi: SbhePhi, basis: HaarBasis, frames: Floats) -> Calls:
    """Calls of a library's operators, on one frame and on all of them.

    Parameters
    ----------
    name : str
        One of `PEERS`.
    phi, basis
        The operators.
    frames : ndarray of float32, shape (k, n_rows, n_cols)
    """
    return PEERS[name][1](phi, basis, frames)


def _depth(basis: HaarBasis) -> int:
    return int(np.floor(np.log2(min(basis.n_rows, basis.n_cols))))


def _pywavelets(phi: SbhePhi, basis: HaarBasis, frames: Floats) -> Calls:
    """Its own 2-D transform; where a side is odd it repeats the last sample, and is longer."""
    import pywt

    options: dict[str, Any] = {"wavelet": "haar", "mode": "periodization", "axes": (-2, -1)}
    analysis = partial(pywt.wavedec2, level=_depth(basis), **options)
    calls: Calls = {ANALYSIS: {}, SYNTHESIS: {}}
    for count, given in ((1, frames[0]), (len(frames), frames)):
        calls[ANALYSIS][count] = partial(analysis, given)
        calls[SYNTHESIS][count] = partial(pywt.waverec2, analysis(given), **options)
    return calls


def _sparse(phi: SbhePhi, basis: HaarBasis, frames: Floats) -> Calls:
    """Compressed rows of the very same matrices."""
    from scipy import sparse

    blocks = [hadamard_matrix(size) / np.sqrt(size) for size in phi.hadamard.sizes]
    hadamard = sparse.block_diag(blocks, format="csr", dtype=np.float32)
    forward = hadamard[phi.rows][:, np.argsort(phi.permutation)]
    atoms, theta = [], np.zeros((basis.n_rows, basis.n_cols), dtype=np.float32)
    for k in range(theta.size):
        theta.flat[k] = 1
        atoms.append(sparse.csr_matrix(basis.synthesis(theta).reshape(1, -1)))
        theta.flat[k] = 0
    analysis = sparse.vstack(atoms, format="csr")
    matrices = {
        **{FORWARD: forward, ADJOINT: forward.T.tocsr()},
        **{ANALYSIS: analysis, SYNTHESIS: analysis.T.tocsr()},
    }
    calls: Calls = {}
    for operator, matrix in matrices.items():
        shape = (matrix.shape[1], len(frames))
        x = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
        calls[operator] = {
            1: partial(matrix.__matmul__, np.ascontiguousarray(x[:, 0])),
            len(frames): partial(matrix.__matmul__, x),
        }
    return calls


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
        matrices = {
            size: (hadamard_matrix(size) / np.sqrt(size)).astype(np.float32)
            for size in phi.hadamard.sizes
        }
        parts = [pylops.MatrixMult(matrices[block], otherdims=(whole,))]
        parts += [pylops.MatrixMult(matrices[size]) for size in phi.hadamard.sizes[whole:]]
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
    applied: dict[str, tuple[Callable[[Floats], Any], Floats]] = {
        FORWARD: (forward.matvec, flat),
        ADJOINT: (forward.rmatvec, y),
        ANALYSIS: (wavelets.matvec, flat),
        SYNTHESIS: (wavelets.rmatvec, theta),
    }
    return {
        operator: {1: partial(apply, vectors[0]), len(frames): partial(_each, apply, vectors)}
        for operator, (apply, vectors) in applied.items()
    }


def _each(apply: Callable[[Floats], Any], vectors: Floats) -> None:
    for one in vectors:
        apply(one)


#: Module and calls of each library.
PEERS: dict[str, tuple[str, Callable[[SbhePhi, HaarBasis, Floats], Calls]]] = {
    "PyWavelets": ("pywt", _pywavelets),
    "scipy.sparse": ("scipy", _sparse),
    "PyLops": ("pylops", _pylops),
}
