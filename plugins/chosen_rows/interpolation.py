"""Interpolation between taxels that were read one by one."""

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.identity import SubsamplePhi
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.solvers.base import Solver, check_reads


class InterpolationSolver(Solver):
    """Forces linear between the taxels that were read.

    Where these are the same in every frame: linear on the triangles of their Delaunay
    triangulation, which is made once; a taxel outside the triangles gets the value of the nearest
    that was read. Where they are on a line, or differ from frame to frame, so that a triangulation
    would cost more than all else: linear along rows, columns and diagonals, `LineInterpolation`.

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

    name = "interpolation"
    uses_basis = False
    follows_choice = True
    reads_taxels = True

    def __init__(self, phi: Phi, basis: Basis, mask: Mask | None = None) -> None:
        super().__init__(phi, basis, mask)
        check_reads(self.name, self, phi.kind, type(phi))
        assert isinstance(phi, SubsamplePhi)
        self._rows_of: SubsamplePhi = phi
        self._cells = np.argwhere(self.mask).astype(np.float64)
        self._y = np.zeros(phi.m, dtype=np.float32)
        self._forces = np.zeros(phi.n, dtype=np.float32)
        self._unread = np.delete(np.arange(phi.n), phi.rows)

        # A choice that differs from frame to frame is interpolated along lines.
        self._lines: LineInterpolation | None = None
        if phi.choice:
            self._lines = LineInterpolation(self.mask)
            return
        read_cells = self._cells[phi.rows]
        other_cells = self._cells[self._unread]
        try:
            corners, weights = interpolated_from(read_cells, other_cells)
            self._corners = corners
            self._weights = weights
        except QhullError:
            # Cells on one line have no area between them.
            self._lines = LineInterpolation(self.mask)

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        """Begin a frame; parameters and Raises as in `solve`. A warm start is not used."""
        self._y = self._checked_y(y)
        self._steps_left = self.n_steps

    def step(self) -> None:
        """Interpolate; Raises as in `Solver`."""
        self._count_step()
        rows = self._rows_of.rows
        if self._lines is not None:
            filled = self._lines.fill(self.taxels[rows], self._y)
            self._forces = filled[self.taxels]
            return

        self._forces[rows] = self._y
        corners = self._y[self._corners]
        self._forces[self._unread] = np.einsum("ij,ij->i", corners, self._weights)

    def finish(self) -> Floats:
        self._steps_left = 0
        image = np.zeros(self.mask.shape, dtype=np.float32)
        image.reshape(-1)[self.taxels] = np.maximum(self._forces, 0)
        return image

    def reset(self) -> None:
        # Nothing else is carried from frame to frame.
        self.watch = None


class LineInterpolation:
    """Values between known ones on a grid's rows, columns and diagonals.

    A cell that lies between two known cells on a line through it gets their linear interpolation;
    of several lines the mean, weighted by 1 / (product of the two distances), as the error of
    linear interpolation is proportional to that product. Cells found so are known in the next
    pass, until no cell lies between others; the rest get the value of the nearest cell known at
    first. Linear fields are reproduced, and no value is outside the range of the known ones. It
    costs about a tenth of a Delaunay triangulation. `wanted`, bool (n_rows, n_cols), is True where
    a value is wanted; lines run through the other cells, too.
    """

    def __init__(self, wanted: Mask) -> None:
        self._wanted = wanted.reshape(-1)
        self._places = np.argwhere(np.ones_like(wanted))
        i, j = self._places.T
        n = len(i)
        self._cells = np.empty((4, n), dtype=np.intp)
        #: Begin and end of the line that each step is on; steps are numbered through all lines.
        self._first = np.empty((4, n), dtype=np.intp)
        self._last = np.empty((4, n), dtype=np.intp)
        self._steps = np.arange(4 * n).reshape(4, n)
        # The number of its line, and the place on it, of each cell: rows, columns, diagonals.
        directions = ((i, j), (j, i), (i - j, i), (i + j, i))
        for k, (line, along) in enumerate(directions):
            cells = np.lexsort((along, line))
            lines = line[cells]
            _, starts, lengths = np.unique(lines, return_index=True, return_counts=True)
            ends = starts + lengths - 1
            self._cells[k] = cells
            self._first[k] = k * n + starts.repeat(lengths)
            self._last[k] = k * n + ends.repeat(lengths)

        # The square of a step's length: it is longer on diagonals.
        self._step2 = np.repeat([1.0, 1.0, 2.0, 2.0], n)

    def fill(self, known: Indices, values: Floats) -> Floats:
        """Return the values of all cells, float32 (n_rows * n_cols,); 0 where none is found.

        `known` are the flat numbers of the known cells, intp (m,), m >= 1, with their values,
        float32 (m,).
        """
        filled = np.zeros(self._wanted.size, dtype=np.float32)
        filled[known] = values
        is_known = np.zeros(self._wanted.size, dtype=np.bool_)
        is_known[known] = True
        while not is_known[self._wanted].all():
            cells, between = self._between(is_known, filled)
            if not cells.size:
                # No cell lies between others any more.
                missing = np.flatnonzero(self._wanted & ~is_known)
                nearest = cKDTree(self._places[known]).query(self._places[missing])[1]
                filled[missing] = values[nearest]
                break

            filled[cells] = between
            is_known[cells] = True
        return filled

    def _between(self, is_known: Mask, filled: Floats) -> tuple[Indices, Doubles]:
        """Return the cells that lie between known ones on some line, and their values."""
        steps, previous, following = self._steps_between(is_known[self._cells])

        # Linear between the two known cells on the line of each step.
        back = steps - previous
        ahead = following - steps
        low = filled.take(self._cells.take(previous))
        high = filled.take(self._cells.take(following))
        on_line = (low * ahead + high * back) / (back + ahead)

        # The weighted mean of the lines through each cell.
        cells = self._cells.take(steps)
        weights = 1 / (back * ahead * self._step2.take(steps))
        totals = np.bincount(cells, weights, is_known.size)
        sums = np.bincount(cells, weights * on_line, is_known.size)
        between = np.flatnonzero(totals)
        return between, sums[between] / totals[between]

    def _steps_between(self, is_known: Mask) -> tuple[Indices, Indices, Indices]:
        """Return the unknown steps between known ones on their line, and the nearest of these
        before and after each; `is_known` is of the steps, bool (4, n).
        """
        # The known steps before and after each, on its line or beyond it.
        behind = np.where(is_known, self._steps, -1)
        previous = np.maximum.accumulate(behind, axis=1)
        ahead = np.where(is_known, self._steps, self._steps.size)[:, ::-1]
        following = np.minimum.accumulate(ahead, axis=1)[:, ::-1]

        # Both must lie on the line of the step.
        on_same_line = (previous >= self._first) & (following <= self._last)
        steps = np.flatnonzero(on_same_line & ~is_known)
        return steps, previous.take(steps), following.take(steps)


def interpolated_from(known: Doubles, wanted: Doubles) -> tuple[Indices, Floats]:
    """Return linear interpolation from known points, (m, 2), to wanted ones, (n, 2), float64.

    Returns
    -------
    corners : ndarray of intp, shape (n, 3)
        Numbers of the known points that a wanted point lies between.
    weights : ndarray of float32, shape (n, 3)
        Their weights, 0..1, of sum 1.

    Raises
    ------
    QhullError
        If the known points have no area between them.
    """
    triangles = Delaunay(known)
    triangle = triangles.find_simplex(wanted)
    inside = triangle >= 0
    corners = np.zeros((len(wanted), 3), dtype=np.intp)
    weights = np.zeros((len(wanted), 3), dtype=np.float32)
    corners[inside] = triangles.simplices[triangle[inside]]

    # Barycentric coordinates.
    transform = triangles.transform[triangle[inside]]
    offsets = wanted[inside] - transform[:, 2]
    first_two = np.einsum("ijk,ik->ij", transform[:, :2], offsets)
    weights[inside, :2] = first_two
    weights[inside, 2] = 1 - first_two.sum(axis=1)

    # Outside all triangles: the nearest known point.
    corners[~inside, 0] = cKDTree(known).query(wanted[~inside])[1]
    weights[~inside, 0] = 1
    return corners, np.clip(weights, 0, 1)
