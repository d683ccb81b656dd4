"""Learning an orthonormal basis in which the tiles of a recording are sparse."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.haar import HaarBasis
from sparseskin.nodes.reconstructor.learned import MAX_TILE, MIN_TILE, Matrix
from sparseskin.nodes.reconstructor.solver import Mask

#: Coefficients below this part of the range are not worth keeping: 0.1 N of 2.5 N.
KEPT_FRACTION = 0.04
MAX_WINDOWS = 6_000
MAX_ROUNDS = 40
#: Learning ends where a round lowers the cost by less than this part.
LEAST_GAIN = 1e-5


class NoWindowError(SolverError):
    """No window of the frames has a force in it."""


def draw_windows(
    frames: Sequence[Floats],
    mask: Mask | None,
    tile: int,
    threshold: float,
    rng: np.random.Generator,
) -> Matrix:
    """Draw tile-sized windows with a force in them from all over the frames.

    Not the tiles of the grid alone: a contact may stand anywhere on a tile.

    Parameters
    ----------
    frames : sequence of ndarray of float32, shape (n_rows, n_cols)
        Forces.
    mask : ndarray of bool, shape (n_rows, n_cols), optional
        True where a taxel exists; windows with one that does not are left out.
    tile : int
        Side of the windows, 2..32.
    threshold : float
        A window is of use where some force in it is above this.
    rng : Generator

    Returns
    -------
    ndarray of float64, shape (k, tile * tile)
        At most 6000 windows, about as many of each frame.

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
    found: Matrix = np.concatenate(drawn or [np.empty((0, 1))]).astype(np.float64)
    if not len(found):
        raise NoWindowError(f"no window of {tile} x {tile} taxels has a force above {threshold:g}")
    return rng.permutation(found)[:MAX_WINDOWS]


def learn_atoms(windows: Matrix, keep: float, tell: Callable[[], object] = lambda: None) -> Matrix:
    """Learn the orthonormal atoms W that make windows X sparse.

    Alternates between the two halves of min ||W X - Z||^2 + keep^2 ||Z||_0 over W and Z, each of
    which has a closed form: Z is W X with what is below `keep` set to 0, and W = V U^T of the
    singular value decomposition X Z^T = U S V^T. No round raises the cost. It begins with Haar.

    Parameters
    ----------
    windows : ndarray of float64, shape (k, t * t)
        One window a row.
    keep : float
        Coefficients from this on are kept; above 0, in the unit of the windows.
    tell : callable, optional
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
    atoms = haar_atoms(round(windows.shape[1] ** 0.5))
    before = np.inf
    for _ in range(MAX_ROUNDS):
        coefficients = windows @ atoms.T
        dropped = np.abs(coefficients) < keep
        cost = float(np.square(coefficients[dropped]).sum())
        cost += keep**2 * float(np.count_nonzero(~dropped))
        tell()
        if cost > before * (1 - LEAST_GAIN):
            break
        before = cost
        coefficients[dropped] = 0
        u, _, v = np.linalg.svd(coefficients.T @ windows)
        atoms = u @ v
    energy = np.square(windows @ atoms.T).sum(axis=0)
    return atoms[np.argsort(-energy, kind="stable")]


def haar_atoms(tile: int) -> Matrix:
    """The atoms of Haar on one tile: what learning begins with, shape (t * t, t * t)."""
    haar = HaarBasis(tile, tile)
    units: npt.NDArray[np.float32] = np.eye(tile * tile, dtype=np.float32)
    atoms = [haar.synthesis(unit.reshape(tile, tile)).reshape(-1) for unit in units]
    # Whole to float64 again: learning sums thousands of products.
    q, r = np.linalg.qr(np.array(atoms, dtype=np.float64).T)
    atoms_again: Matrix = (q * np.sign(np.diag(r))).T
    return atoms_again
