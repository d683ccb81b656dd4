"""Contacts of a frame, found by a threshold with hysteresis."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.skin import Skin
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask

NEIGHBOURS = np.ones((3, 3), dtype=np.bool_)
"""A taxel and its eight neighbours on the grid; of a skin of points, on its virtual grid."""
HELD = 0.5
"""Part of the least force, and of the force and speed of an event, at which a contact ends, or the
event may come again. Chosen."""
SD_SCALE = 2.0
"""Factor on the standard deviations of independent errors, which neighbours do not have. Fitted: on
two scenes and three presses, 40 x 40 taxels, all taxels read, N/3 and N/8, the true deviations of a
total are 1.4 to 4.6 times those of independent errors (geometric mean 2.4), of a centre 0.7 to 3.1
(1.8)."""


@dataclass(frozen=True)
class Limits:
    """What counts as a contact and as an event.

    `low`, `high`: thresholds of a taxel in units of its error; a contact is made of neighbours
    above the low one, of which one at least exceeds the high one. `force`, `area`: least total, in
    the skin's unit, and least number of taxels. `over`: total above which an event is reported.
    `slide`: speed above which one is, mm/s, or taxels/s where no pitch is known.
    """

    low: float = 2.0
    high: float = 6.0
    force: float = 0.0
    area: int = 1
    over: float = math.inf
    slide: float = math.inf


@dataclass(frozen=True)
class Features:
    """Contacts of one frame, in the order of `labels`: arrays with an entry or row each.

    Attributes
    ----------
    total, total_sd, peak : ndarray of float64, shape (n,)
        Sum of the forces, its standard deviation, and the largest force, in the unit of the forces.
    centre, centre_sd : ndarray of float64, shape (n, 2)
        Row and column of the centre of pressure, from the middle of taxel (0, 0), and deviations.
    area : ndarray of int64, shape (n,)
        Number of taxels.
    place, place_sd, normal : ndarray of float64, shape (n, 3), or None
        Centre in mm, its deviations, and the mean of the unit normals weighted by force, of a skin
        of points.
    index, labels : ndarray of int64, shape (n_pressed,)
        Taxels of the contacts in the flat grid, and the number of the contact of each.
    """

    total: Doubles
    total_sd: Doubles
    peak: Doubles
    centre: Doubles
    centre_sd: Doubles
    area: Indices
    place: Doubles | None
    place_sd: Doubles | None
    normal: Doubles | None
    index: Indices
    labels: Indices


class ContactFinder:
    """Finds the contacts of frames of one skin.

    Neighbours of a skin of points are those on its virtual grid, on which neighbours are
    neighbours on the surface.
    """

    def __init__(self, skin: Skin) -> None:
        from scipy import ndimage  # half the time of the start of a process: only where it is used

        self._label = ndimage.label
        self._n_taxels, self._n_cols = skin.n_taxels, skin.n_cols
        cells = np.divmod(np.arange(skin.n_rows * skin.n_cols), skin.n_cols)
        self._cells = np.array(cells, dtype=np.float64)
        self._points: Doubles | None = None
        if skin.points is not None:
            self._points = np.zeros((6, self._cells.shape[1]))
            self._points[:, skin.exists.reshape(-1)] = skin.points.T
            self._points[:3] *= 1e3

    def find(
        self,
        forces: Floats,
        error: float,
        limits: Limits,
        *,
        unit: float | None = None,
        is_mean: bool = False,
        sd: Floats | None = None,
        known: npt.NDArray[np.int32] | None = None,
    ) -> Features | None:
        """Contacts of a frame, float32 (n_rows, n_cols), 0 in masked cells; None: there are none.

        `error`: RMS error of a taxel, in the unit of the forces; `is_mean`: it is that over all
        taxels of the skin, of which those that are 0 have none. `unit`: that of the thresholds, by
        default the error. `sd`: standard deviation of each force, in place of the error. `known`:
        numbers of earlier contacts at their taxels, from 1 on, else 0, flat: what overlaps most
        with one of them stays a contact above the low threshold, with half of the least force.
        """
        unit = error if unit is None else unit
        low, high = np.float32(limits.low * unit), limits.high * unit
        if float(forces.max()) <= (high if known is None else low):
            return None
        pressed = forces > low
        rows, cols = (np.flatnonzero(pressed.any(axis=axis)) for axis in (1, 0))
        box = pressed[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
        grid, n = self._label(box, NEIGHBOURS)
        in_box = np.flatnonzero(box)
        labels = grid.reshape(-1)[in_box].astype(np.intp) - 1
        row, col = np.divmod(in_box, box.shape[1])
        index = (row + rows[0]) * self._n_cols + (col + cols[0])
        values = forces.reshape(-1)[index].astype(np.float64)
        n_pressed = index.size
        total = np.bincount(labels, values, n).astype(np.float64)
        area = np.bincount(labels, minlength=n)
        peak = np.zeros(n)
        np.maximum.at(peak, labels, values)
        kept = (peak > high) & (total >= limits.force) & (area >= limits.area)
        if known is not None and not kept.all():
            overlap = overlaps(labels, known[index], n, int(known.max()))
            held = np.zeros(n, dtype=np.bool_)
            held[overlap.argmax(axis=0)[overlap.any(axis=0)]] = True
            kept |= held & (total >= HELD * limits.force)
        if not kept.all():
            if not kept.any():
                return None
            inside, numbers = kept[labels], np.cumsum(kept) - 1
            index, values, labels = index[inside], values[inside], numbers[labels[inside]]
            total, area, peak, n = total[kept], area[kept], peak[kept], int(numbers[-1]) + 1
        if sd is not None:
            error2 = np.square(sd.reshape(-1)[index], dtype=np.float64)
        else:
            share = self._n_taxels / n_pressed if is_mean else 1.0
            error2 = np.full(index.size, SD_SCALE**2 * share * error**2)

        def mean_of(places: Doubles) -> tuple[Doubles, Doubles]:
            """Centres, and by the delta method their deviations, rows of (n, number of places)."""
            here = places[:, index]
            means = np.stack([np.bincount(labels, values * one, n) for one in here]) / total
            apart = error2 * np.square(here - means[:, labels])
            variances = np.stack([np.bincount(labels, one, n) for one in apart])
            return means.T, (np.sqrt(variances) / total).T

        centre, centre_sd = mean_of(self._cells)
        place = place_sd = normal = None
        if self._points is not None:
            place, place_sd = mean_of(self._points[:3])
            normal = mean_of(self._points[3:])[0]
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        total_sd = np.sqrt(np.bincount(labels, error2, n))
        return Features(
            total=total,
            total_sd=total_sd,
            peak=peak,
            centre=centre,
            centre_sd=centre_sd,
            area=area,
            place=place,
            place_sd=place_sd,
            normal=normal,
            index=index,
            labels=labels,
        )


def overlaps(labels: Indices, known: npt.NDArray[np.int32], n: int, n_known: int) -> Indices:
    """Numbers of taxels that contacts and earlier ones have in common, shape (n, n_known).

    `labels`: number of the contact of each pressed taxel; `known`: that of the earlier one there,
    from 1 on, or 0.
    """
    p = n_known + 1
    return np.bincount(labels * p + known, minlength=n * p).reshape(n, p)[:, 1:]


def find_contacts(
    forces: Floats,
    error: float,
    *,
    mask: Mask | None = None,
    sd: Floats | None = None,
    is_mean: bool = False,
    low: float = Limits.low,
    high: float = Limits.high,
    force: float = 0.0,
    area: int = 1,
) -> Features:
    """Find the contacts of one frame.

    Parameters
    ----------
    forces : ndarray of float32, shape (n_rows, n_cols)
    error : float
        RMS error of a taxel, above 0, in the unit of the forces: of readings their noise.
    mask : ndarray of bool, shape (n_rows, n_cols), optional
        True where a taxel exists; by default everywhere.
    sd : ndarray of float32, shape (n_rows, n_cols), optional
        Standard deviation of each force, in place of the error in `total_sd` and `centre_sd`.
    is_mean : bool
        True if the error is that over all taxels of the skin, as a solver estimates it.
    low, high : float
        Thresholds in units of the error: a contact is made of neighbours (of eight) above the low
        one, of which one at least exceeds the high one.
    force, area
        Least total of a contact, in the unit of the forces, and least number of its taxels.

    Returns
    -------
    Features
        Arrays with an entry for each contact: total, centre, area, peak, standard deviations.

    Examples
    --------
    >>> import numpy as np, sparseskin
    >>> forces = np.zeros((16, 16), dtype=np.float32)
    >>> forces[4:7, 8:10] = 0.5
    >>> found = sparseskin.find_contacts(forces, error=0.014)
    >>> found.total.tolist(), found.centre.tolist(), found.area.tolist()
    ([3.0], [[5.0, 8.5]], [6])
    """
    forces = np.asarray(forces, dtype=np.float32)
    n_rows, n_cols = forces.shape
    skin = Skin(n_rows, n_cols, f_max=1.0, mask=mask)
    forces = np.where(skin.exists, forces, np.float32(0))
    limits = Limits(low, high, force, area)
    found = ContactFinder(skin).find(forces, error, limits, is_mean=is_mean, sd=sd)
    return Features(*_NOTHING) if found is None else found


_NONE, _NONE_2, _NO_INDEX = np.zeros(0), np.zeros((0, 2)), np.zeros(0, dtype=np.intp)
_NOTHING: Any = (
    *(_NONE, _NONE, _NONE, _NONE_2, _NONE_2, _NO_INDEX),
    *(None, None, None, _NO_INDEX, _NO_INDEX),
)
