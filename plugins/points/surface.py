"""The surface on which points lie: its neighbours, its parts, and each part flattened to a plane.

Neighbours are the nearest points whose normals lie within 72 degrees: the two sides of a thin plate
are not neighbours. A closed band, as around a torso, is cut open where the fewest neighbours are
cut apart. Each part is laid flat by multidimensional scaling of the lengths of shortest ways on it,
and the plane then made as rigid as possible: each point and its neighbours are turned, not
stretched.

Sources: Tenenbaum, de Silva, Langford, "A global geometric framework for nonlinear dimensionality
reduction", Science 290, 2000; de Silva, Tenenbaum, "Sparse multidimensional scaling using landmark
points", Stanford 2004; Liu et al., "A local/global approach to mesh parameterization", Computer
Graphics Forum 27(5), 2008.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from sparseskin.nodes.numerics.arrays import Doubles, Indices, Mask

N_NEIGHBOURS = 8
"""Neighbours of a point: those of a square grid, diagonals included."""
_SEARCHED = 4 * N_NEIGHBOURS
"""Points among which they are searched: half of them may be of another side, the rest too far."""
LEAST_COSINE = 0.3
"""Least cosine between normals of neighbours."""
LONGEST = 3.0
"""Longest distance of neighbours in those of the nearest: two taxels may be missing between."""
FLAT = 0.2
"""Distance from a plane, in those of the nearest, up to which a part is flat already."""
N_LANDMARKS = 60
N_RIGID = 30
"""Rounds in which a plane is made as rigid as possible; chosen: a tenth changes little more."""
N_SECTORS = 72
"""Sectors around an axis, of which none is empty where a band is closed."""
MOST_OUTWARD = 0.9
"""Part of the normals that point away from the axis of a closed band, at least."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Pairs of neighbours a, b, in both directions and ascending, and their distance in metres,
    (n_edges,).
    """

    a: Indices
    b: Indices
    length: Doubles

    def only(self, choice: Mask) -> "Edges":
        """Those of a choice, bool (n_edges,)."""
        return Edges(self.a[choice], self.b[choice], self.length[choice])

    def matrix(self, n: int) -> csr_matrix:
        """Lengths as a sparse matrix, (n, n)."""
        return csr_matrix((self.length, (self.a, self.b)), (n, n))


def neighbours(places: Doubles, normals: Doubles) -> Edges:
    """Neighbours of points: float64 (n, 3) each, in metres and of length 1."""
    n = len(places)
    if n == 1:
        return _none()
    distance, near = cKDTree(places).query(places, k=min(_SEARCHED + 1, n))
    # The nearest point is the point itself.
    distance = distance[:, 1:]
    near = near[:, 1:]
    cosine = np.einsum("ij,ikj->ik", normals, normals[near])
    is_same_side = cosine > LEAST_COSINE
    nearest = np.where(is_same_side, distance, np.inf).min(axis=1)
    has_near = np.isfinite(nearest)
    if not has_near.any():
        return _none()

    # Neighbours of a point that lies apart are farther than those of the others.
    typical = float(np.median(nearest[has_near]))
    nearest[~has_near] = 0.0
    limit = LONGEST * np.maximum(typical, nearest)

    # The first few of those that are near enough, which are sorted by their distance.
    is_near = is_same_side & (distance < limit[:, None])
    is_neighbour = is_near & (np.cumsum(is_near, axis=1) <= N_NEIGHBOURS)

    # Each pair once in each direction.
    a, k = np.nonzero(is_neighbour)
    pairs = np.stack([a, near[a, k]], axis=1)
    both_ways = np.concatenate([pairs, pairs[:, ::-1]])
    a, b = np.unique(both_ways, axis=0).T
    length = np.linalg.norm(places[a] - places[b], axis=1)
    return Edges(a, b, length)


def _none() -> Edges:
    none = np.empty(0, dtype=np.intp)
    return Edges(none, none, np.empty(0))


def parts(edges: Edges, n: int) -> list[Indices]:
    """Points of each connected part, the largest part first."""
    n_parts, label = connected_components(edges.matrix(n), directed=False)
    sizes = np.bincount(label, minlength=n_parts)
    order = np.argsort(-sizes, kind="stable")
    return [np.flatnonzero(label == k) for k in order]


def flattened(places: Doubles, normals: Doubles, edges: Edges) -> Doubles:
    """Coordinates in a plane of the points of one part, seen from outside: float64 (n, 2), metres.
    The second axis points up, as far as the skin has an upper end. `places`, `normals`: (n, 3), in
    metres and of length 1.
    """
    n = len(places)
    if n < 4:
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        return np.stack([along, np.zeros(n)], axis=1)

    frames = _tangents(places, normals, edges)
    centred = places - places.mean(axis=0)
    _, size, axes = np.linalg.svd(centred, full_matrices=False)

    # A part that is flat already is laid down as it is.
    height = np.abs(centred @ axes[2]).max()
    if height <= FLAT * np.median(edges.length):
        plane: Doubles = centred @ axes[:2].T
    else:
        edges = edges.only(~_cut(centred, normals, edges))
        plane = _scaled(edges, n)

    # Mirrored if it is seen from inside.
    moments = _moments(plane, places, frames, edges)
    if (np.linalg.det(moments) < 0).mean() > 0.5:
        plane[:, 0] *= -1

    # A part that is not flat is bent as little as possible.
    if size[2] > 0 and height > FLAT * np.median(edges.length):
        plane = _rigid(plane, places, frames, edges)
    return plane


def summed(at: Indices, values: Doubles, n: int) -> Doubles:
    """Sums of the rows of `values`, (n_edges, k), by their point: float64 (n, k)."""
    sums = [np.bincount(at, column, minlength=n) for column in values.T]
    return np.stack(sums, axis=1)


def _tangents(places: Doubles, normals: Doubles, edges: Edges) -> Doubles:
    """Axes of each point's tangent plane by its neighbours, (n, 2, 3), to the right and up from
    outside.
    """
    n = len(places)
    step = places[edges.b] - places[edges.a]
    # Second moments of the steps to the neighbours.
    products = step[:, :, None] * step[:, None, :]
    moments = summed(edges.a, products.reshape(-1, 9), n)
    _, axes = np.linalg.eigh(moments.reshape(n, 3, 3))

    # The direction in which the neighbours spread least, outwards.
    across: Doubles = axes[:, :, 0]
    side = np.einsum("ij,ij->i", across, normals)
    across = across * np.where(side < 0, -1.0, 1.0)[:, None]
    rightward = _rightward(across)
    return np.stack([rightward, np.cross(across, rightward)], axis=1)


def _rightward(across: Doubles) -> Doubles:
    """Directions to the right of who looks at a surface with these normals, (n, 3), up being +z."""
    rightward = np.cross([0.0, 0.0, 1.0], across)
    # On level parts, where +z has no direction in the plane, up is +y.
    is_level = np.linalg.norm(rightward, axis=1) < 0.1
    rightward[is_level] = np.cross([0.0, 1.0, 0.0], across[is_level])
    unit: Doubles = rightward / np.linalg.norm(rightward, axis=1, keepdims=True)
    return unit


def _cut(centred: Doubles, normals: Doubles, edges: Edges) -> Mask:
    """Edges across which a closed band is cut open, bool (n_edges,); none where it is open."""
    n = len(centred)
    is_cut = np.zeros(len(edges.a), dtype=np.bool_)
    longest = -1.0
    for axis in range(3):
        x, y = np.delete(centred, axis, axis=1).T
        angle = np.arctan2(y, x)
        n_sectors = min(N_SECTORS, max(4, int(np.sqrt(n))))
        part_of_turn = (angle + np.pi) / (2 * np.pi)
        sector = (part_of_turn * n_sectors).astype(np.intp) % n_sectors
        is_all_around = len(np.unique(sector)) == n_sectors

        # Normals of a band point away from its axis.
        radial = centred.copy()
        radial[:, axis] = 0
        outward = np.einsum("ij,ij->i", radial, normals)
        is_outward = (outward > 0).mean() >= MOST_OUTWARD
        if not is_all_around or not is_outward:
            continue

        # The longest band is cut, where the fewest edges cross the cut.
        length = float(np.ptp(centred[:, axis]))
        if length > longest:
            longest = length
            cuts = np.linspace(-np.pi, np.pi, N_SECTORS, endpoint=False)
            crossings = [_crossing(angle, edges, cut) for cut in cuts]
            is_cut = min(crossings, key=np.count_nonzero)
    return is_cut


def _crossing(angle: Doubles, edges: Edges, cut: float) -> Mask:
    """Edges whose points lie on the two sides of an angle, bool (n_edges,)."""
    past_cut = (angle - cut) % (2 * np.pi)
    return np.abs(past_cut[edges.a] - past_cut[edges.b]) > np.pi


def _scaled(edges: Edges, n: int) -> Doubles:
    """Plane in which distances are about the lengths of shortest ways, (n, 2)."""
    graph = edges.matrix(n)
    landmarks = [0]
    lengths = [dijkstra(graph, directed=False, indices=0)]

    # Each further landmark is the point that is farthest from those before it.
    to_nearest = lengths[0].copy()
    for _ in range(min(N_LANDMARKS, n) - 1):
        to_nearest[~np.isfinite(to_nearest)] = 0.0
        landmarks.append(int(np.argmax(to_nearest)))
        lengths.append(dijkstra(graph, directed=False, indices=landmarks[-1]))
        to_nearest = np.minimum(to_nearest, lengths[-1])

    # A cut may leave a point alone: it is as far as the farthest other one.
    squared = np.stack(lengths) ** 2
    is_joined = np.isfinite(squared)
    squared[~is_joined] = squared[is_joined].max()

    # The plane of the landmarks by their squared distances, then all points on it.
    between = squared[:, landmarks]
    mean = between.mean(axis=0)
    inner = -0.5 * (between - mean[:, None] - mean + mean.mean())
    values, vectors = np.linalg.eigh(inner)
    sizes = np.sqrt(np.maximum(values[-2:], 1e-12))
    axes = vectors[:, -2:] / sizes
    plane: Doubles = -0.5 * (squared - mean[:, None]).T @ axes
    return plane


def _moments(plane: Doubles, places: Doubles, frames: Doubles, edges: Edges) -> Doubles:
    """Sum over neighbours of steps in the plane times steps in the tangent plane, (n, 2, 2)."""
    n = len(plane)
    step = plane[edges.b] - plane[edges.a]
    local = _local(places, frames, edges)
    products = step[:, :, None] * local[:, None, :]
    return summed(edges.a, products.reshape(-1, 4), n).reshape(n, 2, 2)


def _local(places: Doubles, frames: Doubles, edges: Edges) -> Doubles:
    """Steps to the neighbours in the tangent plane of the first point, with their full length."""
    step = places[edges.b] - places[edges.a]
    step = np.einsum("eij,ej->ei", frames[edges.a], step)
    flat = np.linalg.norm(step, axis=1)
    stretch = edges.length / np.maximum(flat, 1e-12)
    local: Doubles = step * stretch[:, None]
    return local


def _rigid(plane: Doubles, places: Doubles, frames: Doubles, edges: Edges) -> Doubles:
    """The plane after `N_RIGID` rounds in which each neighbourhood is turned and joined."""
    local = _local(places, frames, edges)
    solve = Joined(edges, len(plane))
    # Pairs in ascending order, by the other point first: each edge in the other direction.
    back = np.lexsort((edges.a, edges.b))
    for _ in range(N_RIGID):
        # The rotation, without a reflection, that is nearest to each moment.
        u, _, v = np.linalg.svd(_moments(plane, places, frames, edges))
        handedness = np.sign(np.linalg.det(u @ v))
        u[:, :, 1] *= handedness[:, None]
        rotations = u @ v
        step = np.einsum("eij,ej->ei", rotations[edges.a], local)
        plane = solve(0.5 * (step - step[back]))
    return plane


class Joined:
    """Coordinates whose differences along edges are as stated, by weighted least squares."""

    def __init__(self, edges: Edges, n: int, weights: Doubles | None = None) -> None:
        self._edges = edges
        self._n = n
        if weights is None:
            weights = np.ones(len(edges.a))
        self._weights = weights

        adjacency = coo_matrix((weights, (edges.a, edges.b)), (n, n)).tocsc()
        degree = np.asarray(adjacency.sum(axis=1)).ravel()
        # The ridge fixes what differences do not: the middle of each part.
        diagonal = coo_matrix((degree + 1e-9, (range(n), range(n))), (n, n)).tocsc()
        self._solve = splu(diagonal - adjacency)

    def __call__(self, steps: Doubles) -> Doubles:
        """Coordinates, float64 (n, 2), about 0; steps: (n_edges, 2), from a to b, both ways."""
        weighted = self._weights[:, None] * steps
        right_side = -summed(self._edges.a, weighted, self._n)
        coordinates: Doubles = self._solve.solve(right_side)
        coordinates -= coordinates.mean(axis=0)
        return coordinates
