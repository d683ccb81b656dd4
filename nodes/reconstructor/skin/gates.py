"""Learned gates: a denoiser of tiles of 8 x 8 taxels, in plain numpy.

A tile u is denoised from the window w of 12 x 12 taxels around it. All numbers are in units of the
deviation of the noise, so that the same weights serve any range of forces:

    a = A w,  h = relu(H [l(a), |l(a)|] + h0),  [g, c] = clip(G h + g0, 0, 1)
    x = relu(c u + S (a * (g - c)))

with l(a) = 4 sign(a) ((1 + |a|)^(1/4) - 1), and the expected squared error of a taxel
e = exp(E h + e0). With c = 0 coefficients are shrunk by the gates g: Haar shrinkage is the special
case in which A and S are the Haar transform and g is a formula. With c = 1 the gates state what is
subtracted from the tile: without noise it passes as it is, whatever A and S are.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask

from .backend import ONE, Array, Backend, ManyPatches

TILE, WINDOW = 8, 12
N_FILTERS, N_HIDDEN = 128, 64
SHIFTS = tuple((5 * i % TILE, (3 * i + i // TILE * 5) % TILE) for i in range(TILE * TILE))
"""Shifts of the tiles, rows and columns, in the order of iterations: each once in 64."""
STANDS_OUT = (3.8, 3.3, 2.6, 2.0)
"""Of `standing_out`, by size of square. Derived: 5 % of the windows of normal noise exceed them,
four of `MANY`; what the gates let pass of others is below 0.005 noise variances a taxel."""
MANY = 81
"""Windows of a skin of 64 x 64."""
CLEARLY = 1.2
"""Of `standing_out`: a switch in place of a ramp would amplify rounding. Chosen."""
QUIET = 0.01
"""Expected squared error of a tile in which nothing stands out. Measured: 0.003 to 0.01."""
FILE = "gates.npz"
FORMULA = "formula"
Places: TypeAlias = npt.NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class Gates:
    """Weights of the denoiser, float32; k filters, h hidden units.

    Attributes
    ----------
    filters : ndarray, shape (k, 144)
        A: filters of a window.
    hidden, hidden_0 : ndarray, shape (h, 2 k) and (h,)
        H and h0.
    gates, gates_0 : ndarray, shape (k + 1, h) and (k + 1,)
        G and g0; the last row gives c.
    synthesis : ndarray, shape (64, k)
        S: the tile of gated coefficients.
    error, error_0 : ndarray, shape (1, h) and (1,)
        E and e0: logarithm of the expected squared error.
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
                found = {
                    name: np.ascontiguousarray(stored[name], np.float32) for name in _shapes(0, 0)
                }
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise SolverError(f"{place}: holds no gates: {error}") from error
        for name, expected in _shapes(len(found["filters"]), len(found["hidden_0"])).items():
            if found[name].shape != expected or not np.isfinite(found[name]).all():
                raise SolverError(
                    f"{place}: {name} has shape {found[name].shape}; "
                    f"expected finite numbers of shape {expected}"
                )
        return cls(**found, fingerprint=hashlib.sha256(content).hexdigest()[:16])

    @classmethod
    def zero(cls) -> Gates:
        """The smallest weights, all 0."""
        made: dict[str, Floats] = {n: np.zeros(s, np.float32) for n, s in _shapes(1, 1).items()}
        return cls(**made, fingerprint="")

    def on(self, backend: Backend) -> Gates:
        """The same weights where the vectors are."""
        weights = {name: backend.array(getattr(self, name)) for name in _shapes(0, 0)}
        return replace(self, **weights)

    def denoise(
        self, windows: Array, strictness: float = 1.0, backend: Backend = ONE
    ) -> tuple[Array, Array]:
        """Return the denoised tiles of windows of unit noise.

        Parameters
        ----------
        windows : array of float32, shape (..., t, 144)
        strictness : float
            As of `Tiles`.
        backend : OnePatch or ManyPatches
            Where the windows and weights are.

        Returns
        -------
        tiles : array of float32, shape (..., t, 64)
            At least 0.
        error : array of float32, shape (..., t)
            Expected mean squared error of a taxel of each tile, in (0, 1].
        """
        part = standing_out(windows, strictness, backend)
        if not isinstance(windows, np.ndarray):  # a device would have to wait for their number
            tiles, error = self.gated(windows, backend)
            return part[..., None] * tiles, QUIET + part * (error - QUIET)
        tiles = np.zeros((*windows.shape[:-1], TILE * TILE), dtype=np.float32)
        error = np.full(windows.shape[:-1], QUIET, dtype=np.float32)
        busy = part > 0
        if busy.any():
            gated, expected = self.gated(windows[busy])
            tiles[busy] = part[busy, None] * gated
            error[busy] += part[busy] * (expected - np.float32(QUIET))
        return tiles, error

    def gated(self, windows: Array, backend: Backend = ONE) -> tuple[Array, Array]:
        """As `denoise`, also of windows in which nothing stands out of the noise."""
        xp = backend.xp
        a = windows @ self.filters.T
        size = 4 * (xp.sqrt(xp.sqrt(1 + abs(a))) - 1)
        levels = xp.concatenate([xp.copysign(size, a), size], axis=-1)
        h = (levels @ self.hidden.T + self.hidden_0).clip(0, None)
        g = (h @ self.gates.T + self.gates_0).clip(0, 1)
        passed = g[..., -1:]
        tiles = passed * inner(windows) + (a * (g[..., :-1] - passed)) @ self.synthesis.T
        log_error = h @ self.error[0] + self.error_0
        return tiles.clip(0, None), xp.exp(log_error.clip(-12, 0))


def inner(windows: Array) -> Array:
    """The tile of each window: (..., 144) to (..., 64)."""
    lead, side = windows.shape[:-1], slice((WINDOW - TILE) // 2, (WINDOW + TILE) // 2)
    return windows.reshape(*lead, WINDOW, WINDOW)[..., side, side].reshape(*lead, -1)


def standing_out(windows: Array, strictness: float = 1.0, backend: Backend = ONE) -> Array:
    """Part of a window of unit noise that counts, float32 (..., t): 0 where nothing stands out.

    By how far a taxel, a square of 3 x 3 or 6 x 6, or the whole window exceeds `STANDS_OUT` times
    `strictness` deviations of its sum: from there to `CLEARLY` times as much it grows to 1.
    """
    xp, lead = backend.xp, windows.shape[:-1]
    single, by_3, by_6, whole = (strictness * limit for limit in STANDS_OUT)
    thirds = windows.reshape(*lead, 4, 3, 4, 3).sum(axis=(-3, -1))
    sixths = thirds.reshape(*lead, 2, 2, 2, 2).sum(axis=(-3, -1))
    most = [
        *(xp.amax(windows, axis=-1) / single, xp.amax(thirds, axis=(-2, -1)) / (3 * by_3)),
        *(xp.amax(sixths, axis=(-2, -1)) / (6 * by_6), sixths.sum(axis=(-2, -1)) / (12 * whole)),
    ]
    found: Array = ((xp.amax(xp.stack(most), axis=0) - 1) / (CLEARLY - 1)).clip(0, 1)
    return found


def _shapes(k: int, h: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of `Gates`."""
    return {
        "filters": (k, WINDOW * WINDOW),
        "hidden": (h, 2 * k),
        "hidden_0": (h,),
        "gates": (k + 1, h),
        "gates_0": (k + 1,),
        "synthesis": (TILE * TILE, k),
        "error": (1, h),
        "error_0": (1,),
    }


@cache
def stored_gates() -> Gates | None:
    """Weights that come with the package, what they were trained on is in the file; None if the
    file was left out.
    """
    place = files("sparseskin.nodes.reconstructor.skin").joinpath(FILE)
    return Gates.read(place.read_bytes(), FILE) if place.is_file() else None


def gates_of(setting: Gates | str | None) -> Gates | None:
    """Return the weights that the setting `gates` of `SkinSolver` names; None: none.

    Raises
    ------
    SolverError
        If it names no file of weights.
    """
    if setting is None:
        return stored_gates()
    if isinstance(setting, Gates):
        return setting
    if not isinstance(setting, str):
        allowed = f'allowed: "{FORMULA}", the path of a .npz file, Gates'
        raise SolverError(f"skin: gates = {setting!r} is not allowed; {allowed}")
    if setting == FORMULA:
        return None
    try:
        return Gates.read(Path(setting).read_bytes(), setting)
    except OSError as error:
        raise SolverError(f"skin: gates: {setting}: {error.strerror}") from error


class Tiles:
    """Windows and tiles of a skin at each of `SHIFTS`, as gathers.

    A cell of a window without a taxel reads the nearest one among its eight neighbours. A vector of
    taxels ends with a 0, which it reads where there is none.

    Parameters
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    places : ndarray of intp, shape (n_rows, n_cols)
        Place in the vector of taxels of each cell; n where none exists.
    n : int
        Number of taxels.

    Attributes
    ----------
    most : int
        Largest number of tiles at any shift.
    windows, back, share : ndarray
        What `tables` returns, of all shifts; not set before it was called.
    counts : ndarray of int64, shape (len(SHIFTS),)
        Tiles of each shift; 0 before `tables` was called.
    strictness : float
        Factor of `STANDS_OUT`, above 0 to 1: of fewer windows, noise exceeds less in any case.
        Derived: the largest of n normal numbers grows with the root of log n.
    """

    def __init__(self, mask: Mask, places: Indices, n: int) -> None:
        self._places, self._n = places, n
        self._read = np.append(places.reshape(-1), n)[nearest_taxels(mask)]
        n_rows, n_cols = mask.shape
        self.most = (-(-n_rows // TILE) + 1) * (-(-n_cols // TILE) + 1)
        self.strictness = min(max(math.sqrt(math.log(self.most) / math.log(MANY)), 1e-6), 1.0)
        n_shifts = len(SHIFTS)
        self.windows = np.empty((n_shifts, self.most, WINDOW * WINDOW), dtype=np.uint32)
        self.back = np.empty((n_shifts, n), dtype=np.uint32)
        self.share = np.empty((n_shifts, self.most), dtype=np.float32)
        self.counts = np.zeros(n_shifts, dtype=np.int64)

    def prepare(self, number: int) -> None:
        """Make the gathers of a shift, by its number, if they are missing."""
        if not self.counts[number]:
            windows, self.back[number], share = self._made(*SHIFTS[number])
            self.counts[number] = n = len(share)
            self.windows[number, :n], self.share[number, :n] = windows, share

    def tables(self, number: int) -> tuple[Places, Places, Floats]:
        """Return the gathers of a shift, by its number.

        Returns
        -------
        windows : ndarray of uint32, shape (t, 144)
            Place in the vector of taxels of each cell of each window.
        back : ndarray of uint32, shape (n,)
            Place in the tiles, flat, of each taxel.
        share : ndarray of float32, shape (t,)
            Part of the taxels that lie in each tile. Tiles without a taxel are left out.
        """
        self.prepare(number)
        n = self.counts[number]
        return self.windows[number, :n], self.back[number], self.share[number, :n]

    def _made(self, row: int, col: int) -> tuple[Places, Places, Floats]:
        n_rows, n_cols = self._places.shape
        down, right = -(-(n_rows + row) // TILE), -(-(n_cols + col) // TILE)
        margin = (WINDOW - TILE) // 2

        def views(places: Indices) -> Indices:
            """Places of the cells of each window: (t, WINDOW, WINDOW)."""
            sides = (margin + row, margin + (down * TILE - n_rows - row))
            across = (margin + col, margin + (right * TILE - n_cols - col))
            canvas = np.pad(places, (sides, across), constant_values=self._n)
            found = np.lib.stride_tricks.sliding_window_view(canvas, (WINDOW, WINDOW))
            return found[::TILE, ::TILE].reshape(down * right, WINDOW, WINDOW)

        inner = views(self._places)[:, margin:-margin, margin:-margin].reshape(down * right, -1)
        windows = views(self._read)
        counts = np.count_nonzero(inner < self._n, axis=1)
        windows, inner = windows[counts > 0], inner[counts > 0].reshape(-1)
        back = np.empty(self._n, dtype=np.uint32)
        exists = inner < self._n
        back[inner[exists]] = np.flatnonzero(exists)
        share = (counts[counts > 0] / self._n).astype(np.float32)
        return windows.reshape(len(windows), -1), back, share


class TilesOfDevice:
    """`Tiles` where the vectors are: the tables of one frame at a time, all of one size."""

    def __init__(self, mask: Mask, places: Indices, n: int, backend: ManyPatches) -> None:
        tiles = Tiles(mask, places, n)
        for number in range(len(SHIFTS)):
            found, _, share = tiles.tables(number)
            tiles.windows[number, len(found) :] = n
            tiles.share[number, len(share) :] = 0
        self.strictness = tiles.strictness
        tables = tiles.windows.astype(np.int64), tiles.back.astype(np.int64), tiles.share
        self._all = [backend.array(table) for table in tables]
        self._now = [backend.copy(table) for table in self._all]

    def load(self, first: int, n: int) -> None:
        """Make n shifts, from the number `first` on, those of this frame: 0 to n - 1."""
        for k in range(min(n, len(SHIFTS))):
            for now, every in zip(self._now, self._all, strict=True):
                now[k] = every[(first + k) % len(SHIFTS)]

    def tables(self, number: int) -> tuple[Array, Array, Array]:
        """As in `Tiles`."""
        windows, back, share = (now[number] for now in self._now)
        return windows, back, share


def places_of(shape: tuple[int, ...], cells: Indices) -> Indices:
    """Return the place in a vector of taxels of each cell, intp `shape`: that of cells[p] is p.

    cells are flat, intp (n,). Where no taxel exists it is n.
    """
    places = np.full(shape, len(cells), dtype=np.intp)
    places.reshape(-1)[cells] = np.arange(len(cells))
    return places


def nearest_taxels(mask: Mask) -> Indices:
    """Return for each cell the flat cell of the nearest taxel, within its eight neighbours.

    mask, bool (n_rows, n_cols), is True where a taxel exists. The result is intp (n_rows, n_cols);
    n_rows * n_cols where there is none.
    """
    if mask.all():
        return np.arange(mask.size).reshape(mask.shape)
    from scipy import ndimage  # half the time of the start of a process: only where it is needed

    far, (row, col) = ndimage.distance_transform_edt(~mask, return_indices=True)
    return np.where(far < 1.5, row * mask.shape[1] + col, mask.size)
