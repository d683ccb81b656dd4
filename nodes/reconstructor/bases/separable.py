"""Bases that are a matrix along each axis: the cosine transform and PyWavelets' families."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np
import pywt
from scipy.fft import dct

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Doubles, Floats

from .base import Basis


class SeparableBasis(Basis):
    """A matrix along each axis, at each level on the approximation of the last one.

    `_levels` holds rows, columns and both matrices of each level; a subclass sets it.
    """

    _levels: list[tuple[int, int, Floats, Floats]]

    def _analysis(self, image: Floats, out: Floats) -> None:
        pyramid = out.reshape(self.n_rows, self.n_cols)
        np.copyto(pyramid, image.reshape(pyramid.shape))
        for rows, cols, along_rows, along_cols in self._levels:
            pyramid[:rows, :cols] = along_rows @ pyramid[:rows, :cols] @ along_cols.T

    def _synthesis(self, coefficients: Floats, out: Floats) -> None:
        pyramid = out.reshape(self.n_rows, self.n_cols)
        np.copyto(pyramid, coefficients.reshape(pyramid.shape))
        for rows, cols, along_rows, along_cols in reversed(self._levels):
            pyramid[:rows, :cols] = along_rows.T @ pyramid[:rows, :cols] @ along_cols


class DctBasis(SeparableBasis):
    """Psi = the orthonormal two-dimensional cosine basis (DCT-II) of the whole grid.

    Source: Ahmed, Natarajan, Rao, "Discrete cosine transform", IEEE Trans. Computers C-23(1),
    1974.
    """

    def __init__(self, n_rows: int, n_cols: int) -> None:
        super().__init__(n_rows, n_cols)
        self._levels = [(n_rows, n_cols, _dct_matrix(n_rows), _dct_matrix(n_cols))]


class WaveletBasis(SeparableBasis):
    """Psi = an orthonormal 2-D wavelet basis of PyWavelets, periodic, full depth, any size.

    At each level one matrix acts along either axis on the approximation of the last level; the
    last sample of an odd side goes on unchanged. Laid out as in `HaarBasis`.

    Parameters
    ----------
    n_rows, n_cols : int
        Size of the grid of taxels.
    wavelet : str
        Name of an orthogonal wavelet of PyWavelets: "db2", "sym4", "coif1" ...

    Raises
    ------
    SolverError
        If there is no such wavelet, or it is not orthogonal; and as in `Basis`.

    Notes
    -----
    Source: the paper, section IV-A, for Haar (D2) against D4, which is "db2" here; Mallat, "A
    theory for multiresolution signal decomposition", IEEE Trans. PAMI 11(7), 1989.
    """

    def __init__(self, n_rows: int, n_cols: int, wavelet: str) -> None:
        super().__init__(n_rows, n_cols)
        self._levels = []
        rows, cols = self.n_rows, self.n_cols
        while rows > 1 or cols > 1:
            self._levels.append(
                (rows, cols, _level_matrix(wavelet, rows), _level_matrix(wavelet, cols))
            )
            rows, cols = (rows + 1) // 2, (cols + 1) // 2


@lru_cache(maxsize=64)
def _dct_matrix(n: int) -> Floats:
    matrix: Floats = dct(np.eye(n), norm="ortho", axis=0).astype(np.float32)
    return matrix


@lru_cache(maxsize=256)
def _level_matrix(wavelet: str, n: int) -> Floats:
    """One level along a side of n: approximations first, float32 (n, n), orthonormal."""
    n_paired = n - n % 2
    level: Doubles = np.eye(n)
    if n_paired:
        parts = pywt.dwt(np.eye(n_paired), _orthogonal(wavelet), mode="periodization", axis=0)
        half = n_paired // 2
        level = np.zeros((n, n))
        level[:half, :n_paired] = parts[0]
        level[n - half :, :n_paired] = parts[1]
        if n % 2:
            level[half, n - 1] = 1.0
    return level.astype(np.float32)


def _orthogonal(name: str) -> pywt.Wavelet:
    try:
        wavelet = pywt.Wavelet(name)
    except ValueError as error:
        raise SolverError(f'basis "{name}": PyWavelets has no such wavelet') from error
    # PyWavelets calls some orthogonal whose filters are only nearly so (dmey).
    taps = np.asarray(wavelet.dec_lo)
    if not wavelet.orthogonal or abs(float(taps @ taps) - 1) > 1e-6:
        raise SolverError(f'basis "{name}": not an orthogonal wavelet (allowed: db*, sym*, coif*)')
    return wavelet


def __getattr__(name: str) -> Callable[..., WaveletBasis]:
    """Return the basis of a PyWavelets wavelet by its name: `separable.sym8(n_rows, n_cols)`."""
    if name not in pywt.wavelist(kind="discrete"):
        raise AttributeError(name)
    return partial(WaveletBasis, wavelet=name)
