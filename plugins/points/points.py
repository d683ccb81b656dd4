"""Places and normals of the taxels of a skin that is no flat grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sparseskin.messages.fields import MAX_ELEMENTS
from sparseskin.messages.skin import MAX_COORDINATE_M, first_far
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Doubles, Indices, Mask

MAX_POINTS = MAX_ELEMENTS // 6
"""Most taxels of a layout: those whose places and normals one message holds."""
_AROUND = 10
"""Nearest taxels, itself included, to whose plane an estimated normal is perpendicular; chosen:
all neighbours on a square grid."""


def check_places(name: str, places: Doubles) -> None:
    """Raise SourceError if a place of a file, float64 (n, 3) in metres, is far away."""
    if (k := first_far(places)) is not None:
        text = f"taxel {k} is not within {MAX_COORDINATE_M:g} m; is its unit right?"
        raise SourceError(f"{name}: {text}")


@dataclass(frozen=True, eq=False)
class Points:
    """Taxels at free places. Raises SourceError if there are none or too many, or one is far away.

    `name`: the file, or the example; `places` in metres, outward `normals` of length 1, float64 (n,
    3) each; `slots`: which of the `n_slots` readings of a frame is that of each taxel, intp (n,),
    the others being ignored; `notes`: what was estimated or left out, a line each; `layout`:
    absolute path of the file, or `example:NAME`.
    """

    name: str
    places: Doubles
    normals: Doubles
    slots: Indices
    n_slots: int
    notes: tuple[str, ...] = ()
    layout: str = ""

    def __post_init__(self) -> None:
        n = len(self.places)
        if not 1 <= n <= MAX_POINTS:
            raise SourceError(f"{self.name}: {n} taxels; allowed are 1..{MAX_POINTS}")
        check_places(self.name, self.places)

    @property
    def n(self) -> int:
        """Number of taxels."""
        return len(self.places)


def estimated_normals(places: Doubles) -> Doubles:
    """Normals of points by the plane of least squares through their neighbours, float64 (n, 3).

    The sign, which neighbours do not tell, is that which points away from the middle of all points;
    on a part that curves back it may be wrong. Source: Hoppe et al., "Surface reconstruction from
    unorganized points", SIGGRAPH 1992.
    """
    n = len(places)
    if n < 3:
        return np.tile([0.0, 0.0, 1.0], (n, 1))
    _, nearest = cKDTree(places).query(places, k=min(_AROUND, n))
    around = places[nearest] - places[nearest].mean(axis=1, keepdims=True)
    _, _, axes = np.linalg.svd(around)
    normals: Doubles = axes[:, 2]
    outward = np.einsum("ij,ij->i", normals, places - places.mean(axis=0))
    # On a flat skin no side is outward: all point to +z, or the axis nearest to it.
    flat = np.abs(outward) < 1e-6 * np.abs(places).max()
    outward[flat] = normals[flat] @ [1e-6, 1e-3, 1.0]
    return normals * np.where(outward < 0, -1.0, 1.0)[:, None]


def doubled(places: Doubles) -> Mask:
    """True for each point that stands where one before it stands, bool (n,)."""
    first = np.unique(places, axis=0, return_index=True)[1]
    found = np.ones(len(places), dtype=np.bool_)
    found[first] = False
    return found
