"""Points of a skin placed on a virtual grid, so that neighbours on the skin are neighbours on it.

Each part of the skin is laid flat (`surface`). Steps between neighbours that are steps of a
lattice, square or hexagonal, are rounded to whole ones, in an orientation that may turn from place
to place, and all steps joined by least squares: a lattice that is bent, stretched or has holes
becomes a grid with cells without a taxel. What is no lattice is kept as it lies. Points then go to
free cells with the least sum of squared distances. All that works on a grid with a mask works on
it.

Source: lattices rounded on a surface: Ray et al., "Periodic global parameterization", ACM
Transactions on Graphics 25(4), 2006; Bommes et al., "Mixed-integer quadrangulation", ACM
Transactions on Graphics 28(3), 2009.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from scipy.spatial import cKDTree

from sparseskin.messages.fields import MAX_ELEMENTS, MAX_SIDE
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import AnyArray, Doubles, Indices, Integers, Mask

from .files import Points, load_points
from .surface import Edges, Joined, flattened, neighbours, parts

SQUARE = 4
HEXAGONAL = 6
_AXES = {SQUARE: np.eye(2), HEXAGONAL: np.array([[1.0, 0.5], [0.0, math.sqrt(0.75)]])}
"""Axes of a lattice of spacing 1, as columns."""
ORDERED = 0.3
"""Least mean cosine of `order` times the angle between two neighbours of a point, at which points
form a lattice; 1 on one, below 0.1 for random points, 0.35 to 0.6 on a torso and on an iCub."""
N_SMOOTHED = 8
"""Rounds in which the orientation of a lattice is averaged over neighbours."""
WHOLE = 0.3
"""Largest distance of a step from a whole one to which it is rounded, in spacings."""
LOOSE = 0.02
"""Weight of a step that is not rounded, in that of one that is."""
N_ROUNDED = 3
"""Rounds of rounding: what the first joined may turn out whole in the second."""
FILLED = 0.85
"""Part of the cells that points without a lattice fill: at 1, some would be placed far away."""
WINDOW = 2
"""Cells around its place among which a point's own is chosen first; more where that fails."""


@dataclass(frozen=True, eq=False)
class Placement:
    """The virtual grid of a layout: rows and columns; the flat cell of each point, intp (n,), no
    two the same; median distance of neighbours, metres; parts without a common neighbour.
    """

    points: Points
    shape: tuple[int, int]
    cells: Indices
    pitch_m: float
    n_parts: int = 1

    def skin(self, f_max: float, unit: str) -> Skin:
        """The skin of this grid with a range."""
        mask = np.zeros(self.shape, dtype=np.bool_)
        mask.reshape(-1)[self.cells] = True
        # Taxels are numbered row by row of the grid.
        order = np.argsort(self.cells)
        rows = np.concatenate([self.points.places, self.points.normals], axis=1)[order]
        points = np.ascontiguousarray(rows, dtype=np.float32)
        exists = None if mask.all() else mask
        of_points = (points, self.point_rows(mask))
        return Skin(*self.shape, f_max, unit, self.pitch_m, exists, *of_points)

    def point_rows(self, exists: Mask) -> Integers:
        """Row of each taxel of a mask of the grid among those of the file, int32 (n_taxels,)."""
        rows = np.full(self.shape, -1, dtype=np.int32)
        rows.reshape(-1)[self.cells] = self.points.slots
        return rows[exists]

    @property
    def layout(self) -> str:
        """Absolute path of the file with the points, or `example:NAME`."""
        return self.points.layout

    def summary(self) -> list[str]:
        """Number of taxels, grid and distance, and the notes on the points, for a log."""
        parts = f", {self.n_parts} parts" if self.n_parts > 1 else ""
        grid = f"{self.shape[0]} x {self.shape[1]}{parts}, {1000 * self.pitch_m:.3g} mm apart"
        lines = [
            f"{self.points.n} taxels on a virtual grid of {grid}",
            *self.points.notes,
        ]
        return [f"{self.points.name}: {line}" for line in lines]

    def check_size(self, n_readings: int) -> None:
        """Raise SourceError unless a frame of so many readings has one for each taxel."""
        points = self.points
        if n_readings not in (points.n, points.n_slots):
            allowed = f"{points.n}"
            if points.n_slots != points.n:
                allowed += f" or {points.n_slots}"
            raise SourceError(
                f"{points.name}: a frame has {n_readings} readings; expected {allowed}, one a taxel"
            )

    def on_grid(self, values: AnyArray, unused: float = 0.0) -> AnyArray:
        """n or n_slots readings of any shape, in the order of the layout, on the grid: shape
        `shape`, same dtype, `unused` in cells without a taxel. Raises SourceError if their number
        is another.
        """
        flat = values.reshape(-1)
        points = self.points
        self.check_size(flat.size)
        if flat.size != points.n:
            flat = flat[points.slots]
        image = np.full(self.shape, unused, dtype=flat.dtype)
        image.reshape(-1)[self.cells] = flat
        return image


def placed(layout: str) -> Placement:
    """The placement of a layout, remembered while the file stays; raises as `load_points`,
    `place`.
    """
    try:
        state = Path(layout).stat()
        version = (state.st_mtime_ns, state.st_size)
    except (OSError, ValueError):
        version = (0, 0)
    return _placed(layout, version)


@lru_cache(maxsize=4)
def _placed(layout: str, _version: tuple[int, int]) -> Placement:
    return place(load_points(layout))


def place(points: Points) -> Placement:
    """Place points on a virtual grid. Raises SourceError if the grid would have more than 4096 rows
    or columns, or 2**20 cells.
    """
    # Several taxels may stand at one place; of these the first is a neighbour of others.
    _, first_taxels, place_of_taxel = np.unique(
        points.places,
        axis=0,
        return_index=True,
        return_inverse=True,
    )
    places = points.places[first_taxels]
    normals = points.normals[first_taxels]
    edges = neighbours(places, normals)

    # A grid for each part of the skin.
    grids = []
    for part in parts(edges, len(places)):
        number = np.full(len(places), -1)
        number[part] = np.arange(len(part))
        inside = edges.only(number[edges.a] >= 0)
        edges_of_part = Edges(number[inside.a], number[inside.b], inside.length)
        lattice = _lattice_of_part(places[part], normals[part], edges_of_part)
        taxels = np.flatnonzero(number[place_of_taxel] >= 0)
        lattice_of_taxels = lattice[number[place_of_taxel[taxels]]]
        grids.append((taxels, _assigned(lattice_of_taxels)))

    rows, cols, shape = _packed(grids, points.n)
    if max(shape) > MAX_SIDE or shape[0] * shape[1] > MAX_ELEMENTS:
        raise SourceError(
            f"{points.name}: its virtual grid would have {shape[0]} x {shape[1]} cells; at most "
            f"{MAX_SIDE} a side and {MAX_ELEMENTS} are allowed"
        )
    cells = rows * shape[1] + cols
    return Placement(points, shape, cells, _pitch_m(edges, len(places)), len(grids))


def _pitch_m(edges: Edges, n: int) -> float:
    """Median distance of the nearest neighbours, metres; 1 if no point has a neighbour."""
    nearest = np.full(n, np.inf)
    np.minimum.at(nearest, edges.a, edges.length)
    distances = nearest[np.isfinite(nearest)]
    if not distances.size:
        return 1.0
    return float(np.median(distances))


def _lattice_of_part(places: Doubles, normals: Doubles, edges: Edges) -> Doubles:
    """Row and column of each point of a part, not yet whole, (n, 2)."""
    n = len(places)
    if n == 1:
        return np.zeros((1, 2))

    plane = flattened(places, normals, edges)
    # Where a band was cut open, its ends are neighbours no more.
    distances = np.linalg.norm(plane[edges.b] - plane[edges.a], axis=1)
    edges = edges.only(distances < 2 * edges.length)
    order, angle = _orientation(plane, edges)
    if not order:
        cells = _squarest(plane) / _cell_size(plane)
        return _upright(cells, places, SQUARE)

    # Steps to the neighbours in the axes of the lattice, in its spacing.
    a = edges.a
    b = edges.b
    spacing = _spacing(plane, edges)
    spacing_of_edge = 0.5 * (spacing[a] + spacing[b])
    # The mean of two angles that are known up to a turn of the lattice.
    angle_of_edge = angle[a] + 0.5 * _wrapped(angle[b] - angle[a], order)
    steps = plane[b] - plane[a]
    steps = _turned(steps, -angle_of_edge) / spacing_of_edge[:, None]
    steps = steps @ np.linalg.inv(_AXES[order]).T
    lattice = _joined(steps, edges, n)
    return _upright(lattice, places, order)


def _squarest(plane: Doubles) -> Doubles:
    """Points turned such that the rectangle around them is the smallest, (n, 2)."""

    def area(turned: Doubles) -> float:
        return float(np.prod(np.ptp(turned, axis=0)))

    # Beyond a quarter turn the rectangles are the same again.
    turns = [_turned(plane, angle) for angle in np.radians(range(90))]
    return min(turns, key=area)


def _cell_size(plane: Doubles) -> float:
    """Side of the cells for points without a lattice: a little less than their distance."""
    distances, _ = cKDTree(plane).query(plane, k=min(SQUARE + 1, len(plane)))
    # The nearest point is the point itself.
    to_others = distances[:, 1:]
    return math.sqrt(FILLED) * max(float(to_others.mean()), 1e-9)


def _spacing(plane: Doubles, edges: Edges) -> Doubles:
    """Distance of each point's nearest neighbours, smoothed over neighbours, (n,)."""
    n = len(plane)
    length = np.linalg.norm(plane[edges.b] - plane[edges.a], axis=1)
    nearest = np.full(n, np.inf)
    np.minimum.at(nearest, edges.a, length)
    has_neighbour = np.isfinite(nearest)
    typical = np.median(nearest[has_neighbour])
    nearest[~has_neighbour] = typical
    # Two points at almost one place say nothing of the lattice.
    np.maximum(nearest, 0.5 * typical, out=nearest)

    count = np.bincount(edges.a, minlength=n) + 1
    for _ in range(N_SMOOTHED):
        of_neighbours = np.bincount(edges.a, nearest[edges.b], minlength=n)
        nearest = (nearest + of_neighbours) / count
    return nearest


def _orientation(plane: Doubles, edges: Edges) -> tuple[int, Doubles]:
    """Order of the lattice, 4 or 6, 0 for none, and its angle at each point, radians (n,)."""
    n = len(plane)
    step = plane[edges.b] - plane[edges.a]
    length = np.linalg.norm(step, axis=1)

    # The nearest neighbours alone have the directions of the lattice.
    spacing = _spacing(plane, edges)[edges.a]
    near = length < 1.25 * spacing
    direction = np.arctan2(step[near, 1], step[near, 0])
    a = edges.a[near]
    b = edges.b[near]
    count = np.bincount(a, minlength=n)
    if (count > 1).mean() < 0.5:
        return 0, np.zeros(n)

    n_pairs = (count * (count - 1)).sum()
    best_order = 0
    best_angle = np.zeros(n)
    best_cosine = ORDERED
    for order in (SQUARE, HEXAGONAL):
        field = np.zeros(n, dtype=np.complex128)
        np.add.at(field, a, np.exp(1j * order * direction))
        # The mean of cos(order x angle between two neighbours of a point): 0 for any directions.
        cosine = float((np.abs(field) ** 2 - count).sum() / n_pairs)
        if cosine <= best_cosine:
            continue
        for _ in range(N_SMOOTHED):
            total = field.copy()
            np.add.at(total, a, field[b])
            field = total / (np.maximum(count, 1) + 1)
        best_order = order
        best_angle = np.angle(field) / order
        best_cosine = cosine

    if not best_order:
        return 0, best_angle
    return best_order, _unwound(best_angle, edges, best_order)


def _unwound(angle: Doubles, edges: Edges, order: int) -> Doubles:
    """Angles, known up to 2 pi / order, such that neighbours differ by little."""
    from scipy.sparse.csgraph import breadth_first_order

    n = len(angle)
    unwound = angle.copy()
    visits, predecessors = breadth_first_order(edges.matrix(n), 0, directed=False)
    for point in visits[1:]:
        before_it = predecessors[point]
        turn = _wrapped(angle[point] - unwound[before_it], order)
        unwound[point] = unwound[before_it] + turn
    return unwound


def _wrapped(angle: Doubles, order: int) -> Doubles:
    """Angles within half of 2 pi / order around 0."""
    period = 2 * np.pi / order
    return (angle + period / 2) % period - period / 2


def _turned(steps: Doubles, angle: Doubles | float) -> Doubles:
    """Steps, (n, 2), turned by an angle each, or by one."""
    cos = np.cos(angle)
    sin = np.sin(angle)
    x, y = steps.T
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)


def _joined(steps: Doubles, edges: Edges, n: int) -> Doubles:
    """Coordinates on a lattice, (n, 2), by steps in its axes, the whole ones rounded."""
    lattice = np.zeros((n, 2))
    for _ in range(N_ROUNDED):
        rounded_steps = np.rint(steps)
        off = np.abs(steps - rounded_steps).max(axis=1)
        is_to_next = np.abs(rounded_steps).max(axis=1) == 1
        is_whole = (off < WHOLE) & is_to_next
        weights = np.where(is_whole, 1.0, LOOSE)
        wanted_steps = np.where(is_whole[:, None], rounded_steps, steps)
        lattice = Joined(edges, n, weights)(wanted_steps)
        steps = lattice[edges.b] - lattice[edges.a]
    return lattice


def _upright(lattice: Doubles, places: Doubles, order: int) -> Doubles:
    """Rows and columns, (n, 2), row 0 at the upper end (+z, on a level skin +y); hexagons in
    rows.
    """
    sizes = np.ptp(places, axis=0)
    is_level = sizes[2] <= 0.1 * sizes.max()
    up = places[:, 1] if is_level else places[:, 2]

    # Turned by whole steps of the lattice, such that y points up.
    axes = _AXES[order]
    flat = lattice @ axes.T
    centred = flat - flat.mean(axis=0)
    (slope_x, slope_y), _, _, _ = np.linalg.lstsq(centred, up - up.mean(), rcond=None)
    n_steps = np.rint(order * np.arctan2(slope_x, slope_y) / (2 * np.pi))
    turned = _turned(flat, 2 * np.pi * n_steps / order)
    x, y = (turned @ np.linalg.inv(axes).T).T

    # Every second row of hexagons stands half a cell aside.
    y = y - _phase(y)
    if order == HEXAGONAL:
        x = x + 0.5 * y - 0.5 * (np.rint(y) % 2)
    return np.stack([-y, x - _phase(x)], axis=1)


def _phase(values: Doubles) -> float:
    """What is to be subtracted so that most values are near whole numbers."""
    return float(np.angle(np.exp(2j * np.pi * values).mean()) / (2 * np.pi))


def _assigned(wanted: Doubles) -> Indices:
    """A cell for each point, (n, 2), no two the same, near the wanted ones."""
    n = len(wanted)
    rounded = np.rint(wanted).astype(np.intp)
    # Where points share a cell, all are matched with cells around them.
    cells: Indices | None = rounded
    window = WINDOW
    if len(np.unique(rounded, axis=0)) < n:
        cells = None
    while cells is None:
        cells = _matched(wanted, rounded, window)
        window *= 2
    cells -= cells.min(axis=0)
    return cells


def _matched(wanted: Doubles, rounded: Indices, window: int) -> Indices | None:
    """The assignment of least squares within a window; None if there is none."""
    n = len(wanted)
    offsets = np.arange(-window, window + 1)
    square = np.stack(np.meshgrid(offsets, offsets), -1).reshape(1, -1, 2)
    cells = rounded[:, None, :] + square
    # The matching takes a cost of 0 for an edge that does not exist.
    cost = ((cells - wanted[:, None, :]) ** 2).sum(axis=-1) + 1e-6

    # Cells are numbered in the rectangle around all windows.
    low = cells.min(axis=(0, 1))
    width = int(np.ptp(cells[..., 1])) + 1
    rows_in, cols_in = np.moveaxis(cells - low, -1, 0)
    number_of_cell = rows_in * width + cols_in
    cells_in_reach, numbers = np.unique(number_of_cell, return_inverse=True)

    # A row of the sparse matrix for each point, with the costs of the cells in its window.
    n_cells = len(offsets) ** 2
    row_begins = np.arange(0, n * n_cells + 1, n_cells)
    entries = (cost.ravel(), numbers.ravel(), row_begins)
    graph = csr_matrix(entries, (n, len(cells_in_reach)))
    try:
        _, chosen_cells = min_weight_full_bipartite_matching(graph)
    except ValueError:
        # Too many points for the cells within their windows.
        return None
    rows, cols = np.divmod(cells_in_reach[chosen_cells], width)
    return np.stack([rows + low[0], cols + low[1]], axis=1)


def _packed(
    grids: list[tuple[Indices, Indices]], n: int
) -> tuple[Indices, Indices, tuple[int, int]]:
    """Rows and columns of all points with the parts side by side, and the size of the grid."""
    rows = np.zeros(n, dtype=np.intp)
    cols = np.zeros(n, dtype=np.intp)
    # The grid is about square, and as wide as the widest part at least.
    area = sum(int(np.prod(cells.max(axis=0) + 2)) for _, cells in grids)
    widest = max(int(cells[:, 1].max()) + 1 for _, cells in grids)
    width_max = max(math.isqrt(area), widest)

    # In shelves, the highest parts first, a free cell between neighbours.
    top = 0
    left_edge = 0
    height = 0
    for part, cells in sorted(grids, key=lambda grid: -int(grid[1][:, 0].max())):
        n_rows, n_cols = (cells.max(axis=0) + 1).tolist()
        if left_edge and left_edge + n_cols > width_max:
            top += height + 1
            left_edge = 0
            height = 0

        rows[part] = cells[:, 0] + top
        cols[part] = cells[:, 1] + left_edge
        left_edge += n_cols + 1
        height = max(height, n_rows)
    shape = (int(rows.max()) + 1, int(cols.max()) + 1)
    return rows, cols, shape
