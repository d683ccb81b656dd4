"""Taxels that were read by themselves; the others by interpolation between them."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial import Delaunay, QhullError, cKDTree

from sparseskin.nodes.compressor.acts import ActsPhi
from sparseskin.nodes.compressor.calls import Floats, Indices
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.compressor.subsample import SubsamplePhi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.line_interpolation import LineInterpolation
from sparseskin.nodes.reconstructor.solver import Mask, Solver

Points: TypeAlias = npt.NDArray[np.float64]


class InterpolationSolver(Solver):
    """Forces linear between the taxels that were read.

    Where these are always the same ones: linear on the triangles of their Delaunay triangulation,
    which is made once. For a taxel outside the triangles the nearest that was read stands; where
    all that were read are on a line, it is linear along the line. Where they are others in each
    frame, a triangulation would cost more than all else: linear along rows, columns and
    diagonals, `LineInterpolation`.

    A taxel that was read keeps its reading, noise included. Nothing is carried from frame to
    frame, and the basis is not used.

    Parameters
    ----------
    phi : SubsamplePhi
        "subsample" or "acts": each measurement is one taxel.
    basis, mask
        As in `Solver`.

    Raises
    ------
    SolverError
        If a measurement of phi is more than one taxel; and as in `Solver`.

    Notes
    -----
    Source: the linear interpolation that Slepyan et al., arXiv 2410.13847, compare with; along
    lines it is ours.
    """

    #: It asks phi anew in each frame which taxels were read.
    follows_choice = True

    def __init__(self, phi: Phi, basis: Basis, mask: Mask | None = None) -> None:
        super().__init__(phi, basis, mask)
        if not isinstance(phi, SubsamplePhi):
            raise SolverError(
                f'solver "interpolation": phi "{phi.kind}" mixes taxels; allowed: acts, subsample'
            )
        self._rows_of: SubsamplePhi = phi
        self._cells = np.argwhere(self.mask).astype(np.float64)
        self._y = np.zeros(phi.m, dtype=np.float32)
        self._forces = np.zeros(phi.n, dtype=np.float32)
        self._done = True  # no frame is begun
        self._lines = LineInterpolation(self.mask) if isinstance(phi, ActsPhi) else None
        if self._lines is None:
            self._wanted = np.delete(np.arange(phi.n), phi.rows)
            self._corners, self._weights = interpolated_from(
                self._cells[phi.rows], self._cells[self._wanted]
            )

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        """Begin a frame; parameters and Raises as in `solve`. A warm start is of no use."""
        self._y = self._checked_y(y)
        self._done = False

    def step(self) -> None:
        """Interpolate.

        Raises
        ------
        SolverError
            If the frame is interpolated, or none was begun.
        """
        if self._done:
            raise SolverError("interpolation: no step is left of the frame's 1")
        self._done = True
        rows = self._rows_of.rows
        if self._lines is not None:
            filled = self._lines.fill(self.taxels[rows], self._y)
            self._forces = filled[self.taxels]
            return
        self._forces[rows] = self._y
        corners = self._y[self._corners]
        self._forces[self._wanted] = np.einsum("ij,ij->i", corners, self._weights)

    def finish(self) -> Floats:
        """End the frame and return its estimate, as `solve` does."""
        self._done = True
        image = np.zeros(self.mask.shape, dtype=np.float32)
        image.reshape(-1)[self.taxels] = np.maximum(self._forces, 0)
        return image

    def reset(self) -> None:
        """Forget all earlier frames: there is nothing to forget."""


def interpolated_from(known: Points, wanted: Points) -> tuple[Indices, Floats]:
    """How values at some points follow linearly from those at others.

    Parameters
    ----------
    known : ndarray of float64, shape (m, 2)
        Points with a value; no two the same, and sorted by the first coordinate, then the second.
    wanted : ndarray of float64, shape (n, 2)
        Points that want one.

    Returns
    -------
    corners : ndarray of intp, shape (n, 3)
        Numbers of the known points that a wanted one lies between.
    weights : ndarray of float32, shape (n, 3)
        Their weights, 0..1, of sum 1.
    """
    if len(known) < 2:
        return np.zeros((len(wanted), 3), dtype=np.intp), _first_alone(len(wanted))
    try:
        triangles = Delaunay(known)
    except QhullError:  # no area between them
        return _along_a_line(known, wanted)
    found = triangles.find_simplex(wanted)
    inside = found >= 0
    corners = np.zeros((len(wanted), 3), dtype=np.intp)
    weights = _first_alone(len(wanted))
    corners[inside] = triangles.simplices[found[inside]]
    transform = triangles.transform[found[inside]]
    first_two = np.einsum("ijk,ik->ij", transform[:, :2], wanted[inside] - transform[:, 2])
    weights[inside, :2] = first_two
    weights[inside, 2] = 1 - first_two.sum(axis=1)
    corners[~inside, 0] = cKDTree(known).query(wanted[~inside])[1]
    return corners, np.clip(weights, 0, 1)


def _along_a_line(known: Points, wanted: Points) -> tuple[Indices, Floats]:
    """As `interpolated_from`, for points on a line, sorted along it."""
    direction = known[-1] - known[0]
    at, wanted_at = known @ direction, wanted @ direction
    after = np.clip(np.searchsorted(at, wanted_at), 1, len(at) - 1)
    part = np.clip((wanted_at - at[after - 1]) / (at[after] - at[after - 1]), 0, 1)
    weights = _first_alone(len(wanted))
    weights[:, 0], weights[:, 1] = 1 - part, part
    return np.stack([after - 1, after, after], axis=1), weights


def _first_alone(n: int) -> Floats:
    weights = np.zeros((n, 3), dtype=np.float32)
    weights[:, 0] = 1
    return weights
