"""The scrambled block Hadamard ensemble in compiled loops, a frame or a batch of frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Floats, Indices
from sparseskin.nodes.compressor.sbhe import SbhePhi
from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.fast import ready
from sparseskin.nodes.fast_kernels import sbhe_adjoint, sbhe_forward


def side_by_side(sizes: Sequence[int]) -> tuple[Indices, npt.NDArray[np.int64]]:
    """Return how the compiled Hadamard transform wants its blocks to lie.

    Parameters
    ----------
    sizes : sequence of int
        Sizes of the blocks in their order, those of one size together.

    Returns
    -------
    columns : ndarray of intp, shape (n,)
        Place p of a vector belongs to column, and after the transform to row, columns[p].
    groups : ndarray of int64, shape (k, 3)
        Start, size and number of the blocks of each size.
    """
    groups, columns, start = [], [], 0
    for size in dict.fromkeys(sizes):
        count = list(sizes).count(size)
        index = np.arange(start, start + size * count, dtype=np.intp)
        columns.append(index.reshape(count, size).T.ravel())
        groups.append((start, size, count))
        start += size * count
    return np.concatenate(columns), np.array(groups, dtype=np.int64)


class CompiledSbhe:
    """Phi and its transpose of an `SbhePhi`; nothing is allocated by either.

    It owns its work array: use one per thread.

    Parameters
    ----------
    phi : SbhePhi
    """

    def __init__(self, phi: SbhePhi) -> None:
        ready(sbhe_forward, sbhe_adjoint)
        self.n, self.m = phi.n, phi.m
        columns, self._groups = side_by_side(phi.hadamard.sizes)
        self._deal = phi.permutation[columns].astype(np.uint32)
        self._kept = np.argsort(columns)[phi.rows].astype(np.uint32)
        self._scale = phi.scale.copy()
        self._v = np.zeros(phi.n, dtype=np.float32)

    def forward(self, x: Floats, out: Floats) -> Floats:
        """Write Phi x of k frames, float32 (k, n), to out, float32 (k, m), both contiguous.

        Raises
        ------
        PhiError
            If either has another shape or type.
        """
        self._check(x, self.n, out, self.m)
        sbhe_forward(x, self._deal, self._scale, self._kept, self._groups, self._v, out)
        return out

    def adjoint(self, y: Floats, out: Floats) -> Floats:
        """Write Phi^T y of k frames, float32 (k, m), to out, float32 (k, n), both contiguous.

        Raises
        ------
        PhiError
            If either has another shape or type.
        """
        self._check(y, self.m, out, self.n)
        sbhe_adjoint(y, self._deal, self._scale, self._kept, self._groups, self._v, out)
        return out

    @staticmethod
    def _check(given: Floats, n_in: int, out: Floats, n_out: int) -> None:
        k = len(given)
        for array, shape in ((given, (k, n_in)), (out, (k, n_out))):
            if array.shape != shape or array.dtype != np.float32 or not array.flags.carray:
                raise PhiError(
                    f"sbhe: an array is {array.dtype} of shape {array.shape}; "
                    f"expected contiguous, writable float32 of shape {shape}"
                )
