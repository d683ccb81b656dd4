"""Bases learned from recordings: one orthonormal matrix for every tile, its file, its training."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.array_files import ArrayFileError, read_npz
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask

from .base import LEARNED, Basis
from .haar import haar_matrix

MIN_TILE, MAX_TILE = 2, 32
#: Largest file of atoms: two of the largest tile's, in float64.
MAX_FILE_BYTES = 16 * MAX_TILE**4
#: How far atoms may be from orthonormal: float32 keeps about 1e-7, a sum of 1024 of them 1e-5.
TOLERANCE = 1e-4
#: Coefficients below this part of the range are set to 0 in training: 0.1 N of 2.5 N.
KEPT_FRACTION = 0.04
#: Windows that training uses at most, and its rounds.
MAX_WINDOWS = 6_000
MAX_ROUNDS = 40
#: Learning ends where a round lowers the cost by less than this part.
LEAST_GAIN = 1e-5


class LearnedBasis(Basis):
    """Psi = the same orthonormal atoms on each tile of the grid.

    The tiles begin at row 0 and column 0. Tiles cut off by the last row or column have atoms cut
    off likewise and made orthonormal again by Gram and Schmidt, in order. The coefficients of a
    tile stand in its place, row by row in the order of the atoms.

    Parameters
    ----------
    n_rows, n_cols : int
        Size of the grid of taxels: any.
    atoms : ndarray of float, shape (t * t, t * t)
        Orthonormal; row k is atom k on a tile of t x t taxels, row by row.
    name : str
        Its name in messages.

    Attributes
    ----------
    label : str
        "learned:", the name and the first 8 characters of the fingerprint.

    Raises
    ------
    SolverError
        If the atoms are not as stated; and as in `Basis`.
    """

    def __init__(self, n_rows: int, n_cols: int, atoms: Doubles, name: str = "") -> None:
        super().__init__(n_rows, n_cols)
        tile = check_atoms(atoms)
        shown = re.sub(r"[^\w.-]", "_", name, flags=re.ASCII)[:64]
        self.label = f"{LEARNED}{shown}#{fingerprint_of_atoms(atoms)[:8]}"
        numbers = np.arange(self.n_rows * self.n_cols).reshape(self.n_rows, self.n_cols)
        self._parts: list[tuple[Indices, Floats]] = []
        for rows in _spans(self.n_rows, tile):
            for cols in _spans(self.n_cols, tile):
                cells = _tiled(numbers[rows[0], cols[0]], rows[1], cols[1])
                self._parts.append((cells, _cut(atoms, tile, rows[1], cols[1])))

    def _analysis(self, image: Floats, out: Floats) -> None:
        for cells, atoms in self._parts:
            out[cells] = image[cells] @ atoms.T

    def _synthesis(self, coefficients: Floats, out: Floats) -> None:
        for cells, atoms in self._parts:
            out[cells] = coefficients[cells] @ atoms


def read_atoms(path: str) -> Doubles:
    """Read the `atoms`, float64 (t * t, t * t), of an .npz that `sparseskin learn-basis` wrote.

    Raises
    ------
    SolverError
        If the file cannot be read or is none of learn-basis, or `check_atoms` refuses the atoms.
    """
    place = f'basis "{LEARNED}{path}"'
    try:
        if Path(path).is_fifo():  # to open it would wait for its writer
            raise SolverError(f"{place}: is no regular file")
        with Path(path).open("rb") as file:
            raw = file.read(MAX_FILE_BYTES + 1)
        if len(raw) > MAX_FILE_BYTES:
            raise SolverError(f"{place}: larger than {MAX_FILE_BYTES} bytes")
        atoms: npt.NDArray[Any] = read_npz(raw, lambda names: ["atoms"], MAX_FILE_BYTES)["atoms"]
    except OSError as error:
        raise SolverError(f"{place}: {error.strerror}") from error
    except ArrayFileError as error:
        raise SolverError(f"{place}: no file of learn-basis, an .npz with `atoms`") from error
    try:
        check_atoms(atoms)
    except SolverError as error:
        raise SolverError(f"{place}: {error}") from error
    read: Doubles = atoms.astype(np.float64)
    return read


def check_atoms(atoms: npt.NDArray[Any]) -> int:
    """Return the side t of the tile that atoms are for.

    Raises
    ------
    SolverError
        If they are not a real matrix of t^2 x t^2, t in 2..32, finite and orthonormal.
    """
    tile = math.isqrt(len(atoms)) if atoms.ndim == 2 else 0
    if atoms.dtype.kind != "f" or atoms.shape != (tile * tile,) * 2:
        raise SolverError(
            f"atoms are {atoms.dtype} of shape {atoms.shape}; expected float of shape "
            "(t * t, t * t), t the side of a tile"
        )
    if not MIN_TILE <= tile <= MAX_TILE:
        raise SolverError(f"atoms are for tiles of {tile}; allowed: {MIN_TILE}..{MAX_TILE}")
    if not np.isfinite(atoms).all():
        raise SolverError("atoms hold numbers that are not finite")
    off = float(np.abs(atoms.astype(np.float64) @ atoms.T - np.eye(len(atoms))).max())
    if off > TOLERANCE:
        raise SolverError(f"atoms are not orthonormal: off by {off:.2g}; allowed: {TOLERANCE:g}")
    return tile


def fingerprint_of_atoms(atoms: Doubles) -> str:
    """Return 16 hexadecimal characters of the SHA-256 over the atoms as little-endian float32."""
    return hashlib.sha256(np.ascontiguousarray(atoms, dtype="<f4").tobytes()).hexdigest()[:16]


def _spans(size: int, tile: int) -> list[tuple[slice, int]]:
    """Return (where, side of a tile there) of a side's whole tiles and of the one cut off."""
    whole = size - size % tile
    spans = [(slice(0, whole), tile), (slice(whole, size), size - whole)]
    return [(where, side) for where, side in spans if where.start < where.stop]


def _tiled(numbers: npt.NDArray[np.intp], height: int, width: int) -> Indices:
    """Return the cells of each tile, shape (n_tiles, height * width)."""
    n_rows, n_cols = numbers.shape
    tiles = numbers.reshape(n_rows // height, height, n_cols // width, width).swapaxes(1, 2)
    return tiles.reshape(-1, height * width)


def _cut(atoms: Doubles, tile: int, height: int, width: int) -> Floats:
    """Return the atoms on a tile cut off to `height` x `width` taxels, orthonormal."""
    if (height, width) == (tile, tile):
        return atoms.astype(np.float32)
    cut = atoms.reshape(-1, tile, tile)[:, :height, :width].reshape(len(atoms), height * width)
    q, r = np.linalg.qr(cut.T)
    signs = np.where(np.diag(r) < 0, -1.0, 1.0)
    return (q * signs).T.astype(np.float32)


class NoWindowError(SolverError):
    """No window of the frames has a force in it."""


def draw_windows(
    frames: Sequence[Floats],
    mask: Mask | None,
    tile: int,
    threshold: float,
    rng: np.random.Generator,
) -> Doubles:
    """Draw tile-sized windows with a force in them, at any place of the frames.

    Parameters
    ----------
    frames : sequence of ndarray of float32, shape (n_rows, n_cols)
        Forces.
    mask : ndarray of bool, shape (n_rows, n_cols), optional
        True where a taxel exists; windows with one that does not are left out.
    tile, threshold : int, float
        Side of the windows, 2..32; a window is used if some force in it is above the threshold.

    Returns
    -------
    ndarray of float64, shape (k, tile * tile)
        At most 6000 windows, about the same number of each frame.

    Raises
    ------
    SolverError
        If the tile does not fit the frames.
    NoWindowError
        If no window has a force in it.
    """
    n_rows, n_cols = frames[0].shape
    most = min(n_rows, n_cols, MAX_TILE)
    if not MIN_TILE <= tile <= most:
        raise SolverError(
            f"tile: {tile} is not allowed for frames of {n_rows} x {n_cols}; "
            f"allowed: {MIN_TILE}..{most}"
        )
    exists = np.ones((n_rows, n_cols), np.bool_) if mask is None else mask
    complete = np.lib.stride_tricks.sliding_window_view(exists, (tile, tile)).all(axis=(2, 3))
    touched = [frame for frame in frames if frame.max() > threshold]
    drawn = []
    for frame in touched:
        windows = np.lib.stride_tricks.sliding_window_view(frame, (tile, tile))
        of_use = np.argwhere(complete & (windows.max(axis=(2, 3)) > threshold))
        most = min(len(of_use), -(-MAX_WINDOWS // len(touched)))
        i, j = rng.permutation(of_use)[:most].T
        drawn.append(windows[i, j].reshape(most, tile * tile))
    found: Doubles = np.concatenate(drawn or [np.empty((0, 1))]).astype(np.float64)
    if not len(found):
        raise NoWindowError(f"no window of {tile} x {tile} taxels has a force above {threshold:g}")
    return rng.permutation(found)[:MAX_WINDOWS]


def learn_atoms(
    windows: Doubles, keep: float, progress: Callable[[], object] = lambda: None
) -> Doubles:
    """Learn the orthonormal atoms W that make windows X sparse.

    Alternates between the two halves of min ||W X - Z||^2 + keep^2 ||Z||_0 over W and Z, each of
    which has a closed form: Z is W X with coefficients below `keep` set to 0, and W = V U^T of
    the singular value decomposition X Z^T = U S V^T. No round raises the cost. W begins as Haar.

    Parameters
    ----------
    windows : ndarray of float64, shape (k, t * t)
        One window a row.
    keep : float
        Least magnitude of a coefficient that is kept; above 0, in the unit of the windows.
    progress : callable, optional
        Called in each round.

    Returns
    -------
    ndarray of float64, shape (t * t, t * t)
        Row k is atom k; the one that holds most of the energy first.

    Notes
    -----
    Source: Ravishankar, Bresler, "Learning sparsifying transforms", IEEE Trans. Signal
    Processing 61(5), 2013; Lesage, Gribonval, Bimbot, Benaroya, "Learning unions of orthonormal
    bases with thresholded singular value decomposition", ICASSP 2005.
    """
    tile = round(windows.shape[1] ** 0.5)
    atoms = haar_matrix((tile, tile))
    before = np.inf
    for _ in range(MAX_ROUNDS):
        coefficients = windows @ atoms.T
        dropped = np.abs(coefficients) < keep
        cost = float(np.square(coefficients[dropped]).sum())
        cost += keep**2 * float(np.count_nonzero(~dropped))
        progress()
        if cost > before * (1 - LEAST_GAIN):
            break
        before = cost
        coefficients[dropped] = 0
        u, _, v = np.linalg.svd(coefficients.T @ windows)
        atoms = u @ v
    energy = np.square(windows @ atoms.T).sum(axis=0)
    return atoms[np.argsort(-energy, kind="stable")]
