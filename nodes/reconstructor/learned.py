"""A basis that was learned from a recording: one orthonormal matrix for every tile of the skin."""

from __future__ import annotations

import hashlib
import math
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Floats, Indices
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.basis import LEARNED, Basis

Matrix = npt.NDArray[np.float64]

MIN_TILE, MAX_TILE = 2, 32
#: How far atoms may be from orthonormal: float32 keeps about 1e-7, a sum of 1024 of them 1e-5.
TOLERANCE = 1e-4


class LearnedBasis(Basis):
    """Psi = the same orthonormal atoms on each tile of the grid.

    The tiles begin at row 0 and column 0. Those that the last rows and columns cut off have the
    atoms cut off likewise and made orthonormal again, the first atoms changed least. The
    coefficients of a tile stand in its place, row by row in the order of the atoms.

    Parameters
    ----------
    n_rows, n_cols : int
        Size of the grid of taxels: any.
    atoms : ndarray of float, shape (t * t, t * t)
        Orthonormal; row k is atom k on a tile of t x t taxels, row by row.
    name : str
        What it is called, for messages.

    Attributes
    ----------
    label : str
        "learned:", the name and the first 8 characters of the fingerprint.

    Raises
    ------
    SolverError
        If the atoms are not as stated; and as in `Basis`.
    """

    def __init__(self, n_rows: int, n_cols: int, atoms: Matrix, name: str = "") -> None:
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


def read_atoms(path: str) -> Matrix:
    """Read the atoms of a file that `sparseskin learn-basis` has written.

    Parameters
    ----------
    path : str
        An .npz with the array `atoms`.

    Returns
    -------
    ndarray of float64, shape (t * t, t * t)

    Raises
    ------
    SolverError
        If the file is missing or no such file, or the atoms are not finite and orthonormal.
    """
    place = f'basis "{LEARNED}{path}"'
    try:
        # Opened as the archive it has to be: np.load would take any array, too.
        with Path(path).open("rb") as file, np.lib.npyio.NpzFile(file) as held:
            atoms: npt.NDArray[Any] = held["atoms"]
    except OSError as error:
        raise SolverError(f"{place}: {error.strerror}") from error
    except (ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise SolverError(f"{place}: no file of learn-basis, an .npz with `atoms`") from error
    try:
        check_atoms(atoms)
    except SolverError as error:
        raise SolverError(f"{place}: {error}") from error
    read: Matrix = atoms.astype(np.float64)
    return read


def check_atoms(atoms: npt.NDArray[Any]) -> int:
    """The side t of the tile that atoms are for.

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


def fingerprint_of_atoms(atoms: Matrix) -> str:
    """16 hexadecimal characters of the SHA-256 over the atoms as little-endian float32."""
    return hashlib.sha256(np.ascontiguousarray(atoms, dtype="<f4").tobytes()).hexdigest()[:16]


def _spans(size: int, tile: int) -> list[tuple[slice, int]]:
    """A side's whole tiles, and what is left of the last: (where, side of a tile there)."""
    whole = size - size % tile
    spans = [(slice(0, whole), tile), (slice(whole, size), size - whole)]
    return [(where, side) for where, side in spans if where.start < where.stop]


def _tiled(numbers: npt.NDArray[np.intp], height: int, width: int) -> Indices:
    """The cells of each tile, shape (n_tiles, height * width)."""
    n_rows, n_cols = numbers.shape
    tiles = numbers.reshape(n_rows // height, height, n_cols // width, width).swapaxes(1, 2)
    return tiles.reshape(-1, height * width)


def _cut(atoms: Matrix, tile: int, height: int, width: int) -> Floats:
    """The atoms on a tile of which only `height` x `width` taxels are left, orthonormal."""
    if (height, width) == (tile, tile):
        return atoms.astype(np.float32)
    cut = atoms.reshape(-1, tile, tile)[:, :height, :width].reshape(len(atoms), height * width)
    # Gram and Schmidt: Q of the atoms one after the other.
    q, r = np.linalg.qr(cut.T)
    signs = np.where(np.diag(r) < 0, -1.0, 1.0)
    return (q * signs).T.astype(np.float32)
