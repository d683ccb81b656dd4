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
from functools import cache, lru_cache
from importlib.resources import files
from io import BytesIO
from pathlib import Path

import numpy as np

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask

from .backend import ONE, Array, Backend, ManyPatches, on_device

TILE, WINDOW = 8, 12
WINDOW_MARGIN = (WINDOW - TILE) // 2
MARGIN = WINDOW_MARGIN + TILE - 1
"""Cells around the skin, of the windows at any shift."""
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
    lead, side = windows.shape[:-1], slice(WINDOW_MARGIN, WINDOW_MARGIN + TILE)
    return windows.reshape(*lead, WINDOW, WINDOW)[..., side, side].reshape(*lead, -1)


def standing_out(windows: Array, strictness: float = 1.0, backend: Backend = ONE) -> Array:
    """Part of a window of unit noise that counts, float32 (..., t): 0 where nothing stands out.

    By how far a taxel, a square of 3 x 3 or 6 x 6, or the whole window exceeds `STANDS_OUT` times
    `strictness` deviations of its sum: from there to `CLEARLY` times as much it grows to 1.
    """
    xp, (of_thirds, of_sixths) = backend.xp, _squares(backend.device)
    single, by_3, by_6, whole = (strictness * limit for limit in STANDS_OUT)
    thirds = windows @ of_thirds
    sixths = thirds @ of_sixths
    most = [
        *(xp.amax(windows, axis=-1) / single, xp.amax(thirds, axis=-1) / (3 * by_3)),
        *(xp.amax(sixths, axis=-1) / (6 * by_6), sixths.sum(axis=-1) / (12 * whole)),
    ]
    found: Array = ((xp.amax(xp.stack(most), axis=0) - 1) / (CLEARLY - 1)).clip(0, 1)
    return found


@cache
def _squares(device: str) -> list[Array]:
    """Matrices that sum a window over its squares of 3 x 3, and these over squares of 2 x 2."""
    sides = np.eye(4).repeat(3, axis=0), np.eye(2).repeat(2, axis=0)
    return [on_device(np.kron(side, side).astype(np.float32), device) for side in sides]


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
    """Windows and tiles of a skin at each of `SHIFTS`, cut from a canvas with a margin around it.

    A cell of the canvas without a taxel reads the nearest one among its eight neighbours. A vector
    of taxels ends with a 0, which it reads where there is none.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns.
    cells : ndarray of intp, shape (n,)
        Flat cell of each place in the vector of taxels.

    Attributes
    ----------
    shape, cells
        As given.
    places : ndarray of intp, shape (n_rows, n_cols)
        Place in the vector of taxels of each cell; n where none exists.
    canvas : ndarray of intp, shape (n_rows + 2 MARGIN, n_cols + 2 MARGIN)
        Place in the vector of taxels that each cell reads.
    shares : tuple of ndarray of float32, shape (t,)
        Part of the taxels that lie in each tile, of each shift.
    most : int
        Largest number of tiles at any shift.
    strictness : float
        Factor of `STANDS_OUT`, above 0 to 1: of fewer windows, noise exceeds less in any case.
        Derived: the largest of n normal numbers grows with the root of log n.
    """

    def __init__(self, shape: tuple[int, ...], cells: Indices) -> None:
        n, self.shape, self.cells = len(cells), shape, cells
        self.places = places = np.full(shape, n, dtype=np.intp)
        places.reshape(-1)[cells] = np.arange(n)
        mask = places < n
        read = np.append(places.reshape(-1), n)[nearest_taxels(mask)]
        self.canvas = np.pad(read, MARGIN, constant_values=n)
        exists = np.pad(mask, MARGIN).astype(np.float32)
        self.shares = tuple(
            inner(self.cut(exists, number)).sum(axis=1) / np.float32(n)
            for number in range(len(SHIFTS))
        )
        self.most = max(map(len, self.shares))
        n_windows = math.prod(-(-side // TILE) + 1 for side in shape)
        self.strictness = min(max(math.sqrt(math.log(n_windows) / math.log(MANY)), 1e-6), 1.0)

    def cut(self, canvas: Array, number: int) -> Array:
        """Windows of a canvas at a shift, by its number: (..., rows, columns) to (..., t, 144)."""
        row, col = (MARGIN - WINDOW_MARGIN - shift for shift in SHIFTS[number])
        part, (*lead, down, across) = canvas[..., row:, col:], canvas.strides
        n_down, n_across = ((side - WINDOW) // TILE + 1 for side in part.shape[-2:])
        shape = *part.shape[:-2], n_down, n_across, WINDOW, WINDOW
        strides = *lead, TILE * down, TILE * across, down, across
        views = np.lib.stride_tricks.as_strided(part, shape, strides, writeable=False)
        return views.reshape(*part.shape[:-2], n_down * n_across, WINDOW * WINDOW)

    def windows(self, taxels: Array, number: int) -> Array:
        """Windows of a vector of taxels, (..., n + 1), at a shift: (..., t, 144)."""
        return self.cut(taxels[..., self.canvas], number)

    def taxels(self, tiles: Array, number: int) -> Array:
        """The vector of taxels, (..., n), of the tiles of a shift, (..., t, 64)."""
        (n_rows, n_cols), (row, col) = self.shape, SHIFTS[number]
        lead, across = tiles.shape[:-2], -(-(n_cols + col) // TILE)
        image = tiles.reshape(*lead, -1, across, TILE, TILE).swapaxes(-3, -2)
        image = image.reshape(*lead, -1, across * TILE)[..., row : row + n_rows, col : col + n_cols]
        return image.reshape(*lead, -1)[..., self.cells]


class TilesOfDevice:
    """`Tiles` where the vectors are, as gathers: those of one frame at a time, all of one size."""

    def __init__(self, tiles: Tiles, backend: ManyPatches) -> None:
        self.places, self.strictness = tiles.places, tiles.strictness
        n_shifts, most, n = len(SHIFTS), tiles.most, len(tiles.cells)
        windows = np.full((n_shifts, most, WINDOW * WINDOW), n)
        back, share = np.empty((n_shifts, n), np.intp), np.zeros((n_shifts, most), np.float32)
        for k, shares in enumerate(tiles.shares):
            t = len(shares)
            windows[k, :t], share[k, :t] = tiles.cut(tiles.canvas, k), shares
            back[k] = tiles.taxels(np.arange(t * TILE * TILE).reshape(t, -1), k)
        self._all = [backend.array(table) for table in (windows, back, share)]
        self._now = [backend.copy(table) for table in self._all]

    def load(self, first: int, n: int) -> None:
        """Make n shifts, from the number `first` on, those of this frame: 0 to n - 1."""
        for k in range(min(n, len(SHIFTS))):
            for now, every in zip(self._now, self._all, strict=True):
                now[k] = every[(first + k) % len(SHIFTS)]

    @property
    def shares(self) -> Array:
        """As in `Tiles`, float32 (len(SHIFTS), t)."""
        return self._now[2]

    def windows(self, taxels: Array, number: int) -> Array:
        """As in `Tiles`."""
        return taxels[..., self._now[0][number]]

    def taxels(self, tiles: Array, number: int) -> Array:
        """As in `Tiles`."""
        return tiles.reshape(*tiles.shape[:-2], -1)[..., self._now[1][number]]


def tiles_of(shape: tuple[int, ...], cells: Indices) -> Tiles:
    """Return the tiles of a skin, as of `Tiles`: the same ones for skins that are alike."""
    return _tiles(shape, np.asarray(cells, dtype=np.intp).tobytes())


@lru_cache(maxsize=16)
def _tiles(shape: tuple[int, ...], cells: bytes) -> Tiles:
    return Tiles(shape, np.frombuffer(cells, dtype=np.intp))


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
