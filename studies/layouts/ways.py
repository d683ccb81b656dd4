"""Ways to put points on a grid, and estimators of the points by each."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices
from sparseskin.nodes.sensor.layouts.placing import Placement, place
from sparseskin.nodes.sensor.layouts.points import Points
from sparseskin.nodes.sensor.layouts.surface import Edges, flattened, neighbours, parts
from sparseskin.studies.evaluate import Estimator, Solved

PLACED, BISECTED, IN_ORDER = "placed", "bisected", "file order"
WAYS = (PLACED, BISECTED, IN_ORDER)


class OnGrid:
    """Estimator of points, (n, 1), by a method on the grid of a placement."""

    def __init__(self, method: Estimator, placement: Placement) -> None:
        self._method, self._placement = method, placement

    def reconstruct(self, taxels: Floats) -> Solved:
        """Estimate one frame; taxels: float32, shape (n, 1), newtons."""
        solved = self._method.reconstruct(self._placement.on_grid(taxels))
        return solved._replace(forces=solved.forces.reshape(-1)[self._placement.cells][:, None])


def placed_by(way: str, points: Points) -> Placement:
    """The placement of points by one of `WAYS`."""
    if way == PLACED:
        return place(points)
    if way == BISECTED:
        return bisected(points)
    side = math.ceil(math.sqrt(points.n))
    return Placement(points, (-(-points.n // side), side), np.arange(points.n), 1.0)


def bisected(points: Points) -> Placement:
    """Points on a grid by halving: of the surface laid flat, half of the points go to each side.

    A side is halved that is longer in cells, until each point has a cell; the grid has a power of
    two of rows and of columns.
    """
    levels = max(1, math.ceil(math.log2(points.n)))
    shape = (1 << levels // 2, 1 << (levels - levels // 2))
    edges = neighbours(points.places, points.normals)
    found = parts(edges, points.n)
    if len(found) > 1:
        raise ValueError("bisected: the skin has several parts")
    plane = flattened(points.places, points.normals, Edges(edges.a, edges.b, edges.length))
    cells = np.empty(points.n, dtype=np.intp)
    _halve(plane * [1, -1], np.arange(points.n), cells, (0, 0), shape, shape[1])
    return Placement(points, shape, cells, 1.0)


def _halve(
    plane: Doubles,
    some: Indices,
    cells: Indices,
    corner: tuple[int, int],
    size: tuple[int, int],
    width: int,
) -> None:
    """Write the cells of some points into a part of the grid."""
    if size == (1, 1):
        cells[some] = corner[0] * width + corner[1]
        return
    axis = 0 if size[0] > size[1] else 1
    # Columns lie along the first axis of the plane, rows along the second.
    some = some[np.argsort(plane[some, 1 - axis], kind="stable")]
    half = [size[0], size[1]]
    half[axis] //= 2
    middle = (some.size + 1) // 2
    other = [corner[0], corner[1]]
    other[axis] += half[axis]
    _halve(plane, some[:middle], cells, corner, (half[0], half[1]), width)
    if some.size > middle:
        _halve(plane, some[middle:], cells, (other[0], other[1]), (half[0], half[1]), width)


def shuffled(points: Points, seed: int) -> tuple[Points, Indices]:
    """The points in any order, and turned in space; with the number of each before."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(points.n)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    moved = replace(
        points, places=points.places[order] @ axes.T, normals=points.normals[order] @ axes.T
    )
    return moved, order
