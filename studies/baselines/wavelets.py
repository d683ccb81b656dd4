"""The cosine basis, and wavelets of PyWavelets, beside the Haar basis of the product."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np
import pywt
from scipy.fft import dct

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.reconstructor.bases.haar import SeparableBasis

BASES = {
    "haar": "haar",
    **{name: f"{__name__}:{name}" for name in ("db2", "db4", "sym4", "coif1")},
    "dct": f"{__name__}:DctBasis",
    "identity": "identity",
}
"""Name for `make_basis` of each basis that is compared, by its label."""


class DctBasis(SeparableBasis):
    """Psi = the orthonormal two-dimensional cosine basis (DCT-II) of the whole grid.

    Source: Ahmed, Natarajan, Rao, "Discrete cosine transform", IEEE Trans. Computers C-23(1),
    1974.
    """

    def __init__(self, n_rows: int, n_cols: int) -> None:
        super().__init__(n_rows, n_cols, _dct_matrix, n_levels=1)


class WaveletBasis(SeparableBasis):
    """Psi = an orthonormal 2-D wavelet basis of PyWavelets, periodic, full depth, any size.

    The last sample of an odd side goes on unchanged. Laid out as in `SeparableBasis`.

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
        super().__init__(n_rows, n_cols, partial(_level_matrix, wavelet))


@lru_cache(maxsize=64)
def _dct_matrix(n: int) -> Doubles:
    matrix: Doubles = dct(np.eye(n), norm="ortho", axis=0)
    return matrix


@lru_cache(maxsize=256)
def _level_matrix(wavelet: str, n: int) -> Doubles:
    """One level along a side of n, as `haar.level_matrix`."""
    n_paired = n - n % 2
    level: Doubles = np.eye(n)
    if n_paired:
        unit = np.eye(n_paired)
        filters = _orthogonal(wavelet)
        means, details = pywt.dwt(unit, filters, mode="periodization", axis=0)
        half = n_paired // 2
        level = np.zeros((n, n))
        level[:half, :n_paired] = means
        level[n - half :, :n_paired] = details
        if n % 2:
            level[half, n - 1] = 1.0
    return level


def _orthogonal(name: str) -> pywt.Wavelet:
    try:
        wavelet = pywt.Wavelet(name)
    except ValueError as error:
        raise SolverError(f'basis "{name}": PyWavelets has no such wavelet') from error
    # PyWavelets calls some orthogonal whose filters are only nearly so (dmey).
    taps = np.asarray(wavelet.dec_lo)
    if not wavelet.orthogonal or abs(float(taps @ taps) - 1) > 1e-6:
        raise SolverError(
            f'basis "{name}": not an orthogonal wavelet (allowed: db*, sym*, coif*)'
        )
    return wavelet


def __getattr__(name: str) -> Callable[..., WaveletBasis]:
    """Return the basis of a PyWavelets wavelet by its name: `separable.sym8(n_rows, n_cols)`."""
    if name not in pywt.wavelist(kind="discrete"):
        raise AttributeError(name)
    return partial(WaveletBasis, wavelet=name)
