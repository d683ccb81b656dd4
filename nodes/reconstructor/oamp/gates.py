"""Learned gates: a denoiser of tiles of 8 x 8 taxels, in plain numpy.

A tile is denoised from the window of 12 x 12 taxels around it. All numbers are in units of the
deviation of the noise, so that the same weights serve any range of forces:

    a = A u,  h = relu(H l(a) + h0),  g = clip(G h + g0, 0, 1),  x = relu(S (a * g))

with l(a) = sign(a) log(1 + |a|), and the expected squared error of a taxel e = exp(E h + e0). Haar
shrinkage is the special case in which A and S are the Haar transform and g is a formula.

Without noise such a tile is off by some part of its forces. Where that is more than the noise, the
window itself is nearer: both are averaged by their expected squared errors.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from io import BytesIO

import numpy as np

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask

TILE, WINDOW = 8, 12
N_FILTERS, N_HIDDEN = 128, 64
SHIFTS = tuple((5 * i % TILE, (3 * i + i // TILE * 5) % TILE) for i in range(TILE * TILE))
"""Shifts of the tiles, rows and columns, in the order of iterations: each once in 64."""
INNER = np.arange(WINDOW**2).reshape(WINDOW, WINDOW)[2:-2, 2:-2].reshape(-1)
"""Places of the tile in its window."""
RELATIVE = 0.005
"""Error of a tile without noise, in its forces. Measured: 0.0025 to 0.006 of edges and pads."""
FILE = "gates.npz"


@dataclass(frozen=True, eq=False)
class Gates:
    """Weights of the denoiser, float32; k filters, h hidden units.

    Attributes
    ----------
    filters : ndarray, shape (k, 144)
        A: filters of a window.
    hidden, hidden_0 : ndarray, shape (h, k) and (h,)
        H and h0.
    gates, gates_0 : ndarray, shape (k, h) and (k,)
        G and g0.
    synthesis : ndarray, shape (64, k)
        S: the tile of gated coefficients.
    error, error_0 : ndarray, shape (1, h) and (1,)
        E and e0: logarithm of the expected squared error.
    prior : ndarray, shape (2,)
        c and d of the prior of `OampSolver`.
    fingerprint : str
        16 hexadecimal characters of the SHA-256 of the file.
    """

    filters: Floats
    hidden: Floats
    hidden_0: Floats
    gates: Floats
    gates_0: Floats
    synthesis: Floats
    error: Floats
    error_0: Floats
    prior: Floats
    fingerprint: str = ""

    @classmethod
    def read(cls, content: bytes, place: str) -> Gates:
        """Read weights from a .npz; `place` is named in errors.

        Raises
        ------
        SolverError
            If it is no such file, or an array is missing, of another shape or not finite.
        """
        try:
            with np.load(BytesIO(content), allow_pickle=False) as stored:
                found = {name: np.ascontiguousarray(stored[name], np.float32) for name in _SHAPES}
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise SolverError(f"{place}: holds no gates: {error}") from error
        k, h = found["gates"].shape if found["gates"].ndim == 2 else (0, 0)
        for name, shape in _SHAPES.items():
            expected = tuple({"k": k, "h": h}.get(str(side), side) for side in shape)
            if found[name].shape != expected or not np.isfinite(found[name]).all():
                raise SolverError(
                    f"{place}: {name} has shape {found[name].shape}; "
                    f"expected finite numbers of shape {expected}"
                )
        return cls(**found, fingerprint=hashlib.sha256(content).hexdigest()[:16])

    def gated(self, windows: Floats) -> tuple[Floats, Floats]:
        """Return the gated tiles of windows of unit noise.

        Parameters
        ----------
        windows : ndarray of float32, shape (t, 144)

        Returns
        -------
        tiles : ndarray of float32, shape (t, 64)
            At least 0.
        error : ndarray of float32, shape (t,)
            Expected mean squared error of a taxel of each tile, in (0, 1].
        """
        a = windows @ self.filters.T
        level = np.log1p(np.abs(a))
        h = np.copysign(level, a, out=level) @ self.hidden.T
        np.maximum(np.add(h, self.hidden_0, out=h), 0, out=h)
        g = h @ self.gates.T
        np.clip(np.add(g, self.gates_0, out=g), 0, 1, out=g)
        tiles = np.multiply(a, g, out=a) @ self.synthesis.T
        log_error = h @ self.error[0] + self.error_0
        return np.maximum(tiles, 0, out=tiles), np.exp(np.clip(log_error, -12, 0))

    def denoise(self, windows: Floats) -> tuple[Floats, Floats]:
        """As `gated`, averaged with the windows themselves where these are nearer."""
        tiles, error = self.gated(windows)
        tile = windows[:, INNER]
        floor = RELATIVE**2 * np.mean(np.square(tile, dtype=np.float64), axis=1)
        part: Floats = (floor / (1 + floor)).astype(np.float32)
        tiles += part[:, None] * (np.maximum(tile, 0) - tiles)
        return tiles, error + part * (1 - error)


_SHAPES: dict[str, tuple[int | str, ...]] = {
    "filters": ("k", WINDOW * WINDOW),
    "hidden": ("h", "k"),
    "hidden_0": ("h",),
    "gates": ("k", "h"),
    "gates_0": ("k",),
    "synthesis": (TILE * TILE, "k"),
    "error": (1, "h"),
    "error_0": (1,),
    "prior": (2,),
}


@cache
def stored_gates() -> Gates:
    """Weights that come with the package; what they were trained on is in the file."""
    place = files("sparseskin.nodes.reconstructor.oamp").joinpath(FILE)
    return Gates.read(place.read_bytes(), FILE)


class Tiles:
    """Windows and tiles of a skin at each of `SHIFTS`, as gathers.

    A vector of taxels ends with a 0, which cells of a window without a taxel read.

    Parameters
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    places : ndarray of intp, shape (n_rows, n_cols)
        Place in the vector of taxels of each cell; n where none exists.
    n : int
        Number of taxels.
    """

    def __init__(self, mask: Mask, places: Indices, n: int) -> None:
        self._mask, self._places, self._n = mask, places, n
        self._tables: dict[int, tuple[Indices, Indices, Floats]] = {}

    def tables(self, number: int) -> tuple[Indices, Indices, Floats]:
        """Return the gathers of a shift, by its number.

        Returns
        -------
        windows : ndarray of intp, shape (t, 144)
            Place in the vector of taxels of each cell of each window.
        back : ndarray of intp, shape (n,)
            Place in the tiles, flat, of each taxel.
        share : ndarray of float32, shape (t,)
            Part of the taxels that lie in each tile. Tiles without a taxel are left out.
        """
        if number not in self._tables:
            self._tables[number] = self._made(*SHIFTS[number])
        return self._tables[number]

    def _made(self, row: int, col: int) -> tuple[Indices, Indices, Floats]:
        n_rows, n_cols = self._mask.shape
        down, right = -(-(n_rows + row) // TILE), -(-(n_cols + col) // TILE)
        margin = (WINDOW - TILE) // 2
        canvas = np.full((down * TILE + 2 * margin, right * TILE + 2 * margin), self._n)
        top, left = margin + row, margin + col
        canvas[top : top + n_rows, left : left + n_cols] = self._places
        views = np.lib.stride_tricks.sliding_window_view(canvas, (WINDOW, WINDOW))
        windows = views[::TILE, ::TILE].reshape(down * right, WINDOW, WINDOW)
        inner = windows[:, margin:-margin, margin:-margin].reshape(down * right, -1)
        counts = np.count_nonzero(inner < self._n, axis=1)
        windows, inner = windows[counts > 0], inner[counts > 0].reshape(-1)
        back = np.empty(self._n, dtype=np.intp)
        exists = inner < self._n
        back[inner[exists]] = np.flatnonzero(exists)
        share = (counts[counts > 0] / self._n).astype(np.float32)
        return np.ascontiguousarray(windows.reshape(len(windows), -1), np.intp), back, share
