"""Places and normals of the taxels of a skin that is no flat grid, and readers of their files.

| file | content                                                                                   |
|------|-------------------------------------------------------------------------------------------|
| .csv | a header x_mm,y_mm,z_mm (or cm, m), with ,nx,ny,nz after it where normals are known, and  |
|      | a line a taxel; lines that begin with # are comments                                      |
| .txt | taxel positions of an iCub (skinGui, skinManager): keys, `[calibration]`, and for each    |
|      | reading x y z nx ny nz in metres, zeros where it has no taxel                             |

A layout is a file, or `example:NAME` for one that is computed (`examples`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sparseskin.messages.fields import MAX_ELEMENTS
from sparseskin.messages.skin import MAX_COORDINATE_M, first_far
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.numerics.arrays import Doubles, Indices, Mask
from sparseskin.nodes.sensor.files.recording import Lines
from sparseskin.nodes.sensor.layout.checks import (
    parse_number,
    parse_whole,
    reading,
    shown,
)

from .examples import EXAMPLES

MAX_POINTS = MAX_ELEMENTS // 6
"""Most taxels of a layout: those whose places and normals one message holds."""
_AROUND = 10
"""Nearest taxels, itself included, to whose plane an estimated normal is perpendicular; chosen:
all neighbours on a square grid."""


def check_places(name: str, places: Doubles) -> None:
    """Raise SourceError if a place of a file, float64 (n, 3) in metres, is far away."""
    k = first_far(places)
    if k is not None:
        raise SourceError(
            f"{name}: taxel {k} is not within {MAX_COORDINATE_M:g} m; is its unit "
            "right?"
        )


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
    """Normals of points by the plane of least squares through their neighbours, float64 (n, 3),
    away from the middle of all points: on a part that curves back the sign may be wrong. Source:
    Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992.
    """
    n = len(places)
    # Two points have no plane: they lie flat.
    if n < 3:
        return np.tile([0.0, 0.0, 1.0], (n, 1))

    # The direction in which the places around a point spread least.
    _, nearest = cKDTree(places).query(places, k=min(_AROUND, n))
    around = places[nearest]
    offsets = around - around.mean(axis=1, keepdims=True)
    _, _, axes = np.linalg.svd(offsets)
    normals: Doubles = axes[:, 2]
    outward = np.einsum("ij,ij->i", normals, places - places.mean(axis=0))

    # On a flat skin no side is outward: all point to +z, or the axis nearest to it.
    is_flat = np.abs(outward) < 1e-6 * np.abs(places).max()
    outward[is_flat] = normals[is_flat] @ [1e-6, 1e-3, 1.0]
    sign = np.where(outward < 0, -1.0, 1.0)
    return normals * sign[:, None]


def doubled(places: Doubles) -> Mask:
    """True for each point that stands where one before it stands, bool (n,)."""
    first_of_place = np.unique(places, axis=0, return_index=True)[1]
    is_double = np.ones(len(places), dtype=np.bool_)
    is_double[first_of_place] = False
    return is_double


EXAMPLE = "example:"
SUFFIXES = (".csv", ".txt")
HEADERS_M = {
    f"x_{unit},y_{unit},z_{unit}": metres
    for unit, metres in (("mm", 0.001), ("cm", 0.01), ("m", 1.0))
}
"""Headers of a .csv, and their unit in metres."""
NORMAL = ",nx,ny,nz"
"""Further columns of a header, where normals are known."""
MAX_BYTES = 256 * MAX_POINTS
"""Largest file, bytes; chosen: six numbers of 42 characters a taxel."""
USUAL_M = 1e-4, 0.2
"""Distances of taxels in metres outside which a unit is doubted; chosen."""
_ICUB_KEYS = ("name", "spatial_sampling", "taxel2Repr")
_CALIBRATION = "[calibration]"
_LEAST_NORMAL = 0.5
"""Least length of a stated normal; chosen: three decimals and rounding leave 0.9."""


def load_points(layout: str) -> Points:
    """Read a layout, a path or `example:NAME`. Raises SourceError if the file is missing, too
    large, of an unknown suffix or malformed, or there is no such example.
    """
    if layout.startswith(EXAMPLE):
        name = layout.removeprefix(EXAMPLE)
        if name not in EXAMPLES:
            hint = did_you_mean(name, EXAMPLES)
            raise SourceError(f"{layout}: no such example{hint}")
        places, normals = EXAMPLES[name]()
        order = np.arange(len(places))
        return Points(name, places, normals, order, len(places), layout=layout)

    suffix = Path(layout).suffix.lower()
    if suffix not in SUFFIXES:
        raise SourceError(
            f"{shown(layout, 200)}: suffix {shown(suffix)} is not known; allowed are "
            f"{', '.join(SUFFIXES)}, and {EXAMPLE}{{{', '.join(EXAMPLES)}}}"
        )
    # Before it is read: a wrong file may be of any size.
    path = Path(layout)
    if path.is_file() and path.stat().st_size > MAX_BYTES:
        size = path.stat().st_size
        raise SourceError(f"{layout}: {size} bytes; at most {MAX_BYTES} are allowed")

    with reading(layout) as file:
        lines = [*Lines(file, layout)]
    if suffix == ".csv":
        return _read_csv(lines, layout)
    return _read_icub(lines, layout)


def _read_csv(lines: Sequence[str], name: str) -> Points:
    header = None
    rows = []
    for number, line in enumerate(lines, start=1):
        where = f"{name}, line {number}"
        # Comments may stand before and between.
        if line.startswith("#") or not line.strip():
            continue
        cells = [cell.strip() for cell in line.split(",")]
        if header is not None:
            rows.append(_row(cells, len(header), where))
        elif ",".join(cells).removesuffix(NORMAL) in HEADERS_M:
            header = cells
        else:
            raise SourceError(
                f"{where}: header {shown(','.join(cells), 80)}; expected {next(iter(HEADERS_M))} "
                f"(or in cm, m), or with {NORMAL[1:]} after it"
            )
    if header is None:
        raise SourceError(f"{name}: holds no header")
    if not rows:
        raise SourceError(f"{name}: holds no taxel")

    values = np.array(rows)
    places = values[:, :3] * HEADERS_M[",".join(header[:3])]
    # A file of one's own has no reason to have two; those of robots have.
    twice = doubled(places)
    if twice.any():
        k = int(np.argmax(twice))
        raise SourceError(f"{name}: taxel {k} (from 0) stands where another does")
    return _points(name, places, values[:, 3:], np.arange(len(rows)), len(rows), ())


def _row(cells: list[str], n: int, where: str) -> list[float]:
    if len(cells) != n:
        raise SourceError(f"{where}: {len(cells)} numbers; expected {n}")
    return [parse_number(cell, where) for cell in cells]


def _read_icub(lines: Sequence[str], name: str) -> Points:
    values = []
    is_used = None
    in_calibration = False
    for number, line in enumerate(lines, start=1):
        where = f"{name}, line {number}"
        if not line.strip():
            continue
        if in_calibration:
            values.append(_row(line.split(), 6, where))
        elif line.strip() == _CALIBRATION:
            in_calibration = True
        else:
            key, _, value = line.strip().replace("\t", " ").partition(" ")
            if key not in _ICUB_KEYS:
                raise SourceError(
                    f"{where}: {shown(key)} is no key of an iCub's taxel positions; expected "
                    f"{', '.join(_ICUB_KEYS)} or {_CALIBRATION}"
                )
            if key == "taxel2Repr":
                is_used = _representatives(value, where)
    if not values:
        raise SourceError(f"{name}: holds no taxel after {_CALIBRATION}")

    notes = []
    if is_used is not None and len(is_used) != len(values):
        # Files of older robots have another number.
        notes.append(
            f"taxel2Repr has {len(is_used)} numbers for {len(values)} lines and is not used"
        )
        is_used = None

    # Readings that are of no taxel, as of a temperature, have zeros as their place.
    rows = np.array(values)
    has_place = rows[:, :3].any(axis=1)
    if is_used is not None:
        has_place &= is_used
    slots = np.flatnonzero(has_place)
    if not slots.size:
        raise SourceError(f"{name}: no reading has a place, all are zeros or unused")

    places = rows[slots, :3]
    n_twice = np.count_nonzero(doubled(places))
    if n_twice:
        notes.append(f"{n_twice} of {slots.size} taxels stand where another does")
    return _points(name, places, rows[slots, 3:], slots, len(rows), tuple(notes))


def _representatives(text: str, where: str) -> Mask:
    """True for each reading of a taxel: negative numbers are of readings that are none."""
    tokens = text.strip().removeprefix("(").removesuffix(")").split()
    is_taxel = []
    for token in tokens:
        # The number itself is that of the taxel which stands for several: it is not used.
        digits = token.removeprefix("-")
        number = parse_whole(digits, f"{where}, taxel2Repr", 0, len(tokens))
        is_taxel.append(not token.startswith("-") or number == 0)
    return np.array(is_taxel, dtype=np.bool_)


def _points(
    name: str,
    places: Doubles,
    normals: Doubles,
    slots: Indices,
    n_slots: int,
    notes: tuple[str, ...],
) -> Points:
    """The layout, with normals of length 1; those that are not stated, or 0, are estimated."""
    # Checked before normals are estimated from them.
    check_places(name, places)
    lengths = np.zeros(len(places))
    if normals.size:
        lengths = np.linalg.norm(normals, axis=1)
    is_unknown = lengths < _LEAST_NORMAL
    is_short = is_unknown & (lengths > 0)
    if is_short.any():
        k = int(np.argmax(is_short))
        raise SourceError(
            f"{name}: the normal of taxel {k} (from 0) has length {lengths[k]:.3g}; "
            "expected 1"
        )

    unit = np.zeros_like(places)
    if is_unknown.any():
        unit = estimated_normals(places)
        of_some = ""
        if not is_unknown.all():
            of_some = f" of {np.count_nonzero(is_unknown)} taxels"
        notes = (
            *notes,
            f"the normals{of_some} are estimated from the places of neighbours",
        )
    is_stated = ~is_unknown
    if is_stated.any():
        unit[is_stated] = normals[is_stated] / lengths[is_stated, None]

    if len(places) > 1:
        distances, _ = cKDTree(places).query(places, 2)
        nearest = float(np.median(distances[:, 1]))
        if nearest and not USUAL_M[0] <= nearest <= USUAL_M[1]:
            notes = (
                *notes,
                f"taxels are {1000 * nearest:.3g} mm apart: is the unit right?",
            )

    layout = str(Path(name).resolve())
    return Points(Path(name).stem, places, unit, slots, n_slots, notes, layout)
