"""Contacts of a frame, found by a threshold with hysteresis."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask, real_floats
from sparseskin.nodes.numerics.compiled import ready, use_compiled

NEIGHBOURS = np.ones((3, 3), dtype=np.bool_)
"""A taxel and its eight neighbours on the grid; of a skin of points, on its virtual grid."""
HELD = 0.5
"""Part of the least force, and of the force and speed of an event, at which a contact ends, or the
event may come again. Chosen."""
AT_ONCE = 2.0
"""Factor of the high threshold above which a contact begins in its first frame; below it, in the
second one in a row that exceeds the threshold at a place. Chosen."""
SD_SCALE = 2.0
"""Factor on the standard deviations of independent errors, which neighbours do not have. Fitted: on
two scenes and three presses, 40 x 40 taxels, all taxels read, N/3 and N/8, the true deviations of a
total are 1.4 to 4.6 times those of independent errors (geometric mean 2.4), of a centre 0.7 to 3.1
(1.8)."""


@dataclass(frozen=True)
class Limits:
    """What counts as a contact and as an event.

    `low`, `high`: thresholds of a taxel in units of its error; a contact is made of neighbours
    above the low one, of which one exceeds the high one in two frames in a row, or `AT_ONCE` times
    as much in one. `force`, `area`: least total, in
    the skin's unit, and least number of taxels. `over`: total above which an event is reported.
    `slide`: speed above which one is, mm/s, or taxels/s where no pitch is known.
    """

    low: float = 2.0
    high: float = 3.0
    force: float = 0.0
    area: int = 1
    over: float = math.inf
    slide: float = math.inf


@dataclass(slots=True)
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
    place, place_sd : ndarray of float64, shape (n, 3), or None
        Centre in mm and its deviations, where the pitch or the points of the skin are known.
    normal : ndarray of float64, shape (n, 3), or None
        Mean of the unit normals weighted by force, of a skin of points.
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
    neighbours on the surface. `fast`: use of the compiled loop, as in `use_compiled`.
    """

    def __init__(self, skin: Skin, fast: str = "off") -> None:
        self._n_taxels = skin.n_taxels
        cells = np.divmod(np.arange(skin.n_rows * skin.n_cols), skin.n_cols)
        self._places = np.array(cells, dtype=np.float64)
        self._alike = np.ones(self._places.shape[1], dtype=np.float32)
        if skin.points is not None:
            points = np.zeros((6, self._alike.size))
            points[:, skin.exists.reshape(-1)] = skin.points.T
            points[:3] *= 1e3
            self._places = np.concatenate([self._places, points])
        elif skin.pitch_m is not None:
            flat = 1e3 * skin.pitch_m * self._places[::-1]
            self._places = np.concatenate([self._places, flat, np.zeros_like(flat[:1])])
        self._components: Callable[..., tuple[Indices, Indices, Doubles]] = components
        if use_compiled(fast):
            from sparseskin.nodes.numerics import kernels  # needs numba

            ready(kernels.components)
            self._components = kernels.components

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
        waiting: Mask | None = None,
    ) -> Features | None:
        """Contacts of a frame, float32 (n_rows, n_cols), 0 in masked cells; None: there are none.

        `error`: RMS error of a taxel, in the unit of the forces; `is_mean`: it is that over all
        taxels of the skin, of which those that are 0 have none. `unit`: that of the thresholds, by
        default the error. `sd`: standard deviation of each force, in place of the error. `known`:
        numbers of earlier contacts at their taxels, from 1 on, else 0, flat: what overlaps most
        with one of them stays a contact above the low threshold, with half of the least force.
        `waiting`: flat, the cells of what exceeded the high threshold in the frame before, but not
        `AT_ONCE` times; becomes those of this frame. None: whatever exceeds it begins at once.
        """
        unit = error if unit is None else unit
        low, high = np.float32(limits.low * unit), limits.high * unit
        if known is None and float(forces.max()) <= high:
            if waiting is not None:
                waiting[:] = False
            return None
        forces = np.ascontiguousarray(forces, dtype=np.float32)
        weights = self._alike if sd is None else np.square(sd, dtype=np.float32).reshape(-1)
        index, labels, sums = self._components(forces, low, weights, self._places)
        n, n_pressed = sums.shape[1], index.size
        total, area, peak = sums[:3]
        fits = (total >= limits.force) & (area >= limits.area)
        kept = fits & (peak > (high if waiting is None else AT_ONCE * high))
        if known is not None and not kept.all():
            overlap = overlaps(labels, known[index], n, int(known.max()))
            held = np.zeros(n, dtype=np.bool_)
            held[overlap.argmax(axis=0)[overlap.any(axis=0)]] = True
            kept |= held & (total >= HELD * limits.force)
        if waiting is not None:
            again = None if kept.all() else np.bincount(labels, waiting[index], n) > 0
            waiting[:] = False
            if again is not None:
                weak = fits & (peak > high) & ~kept
                kept |= weak & again
                waiting[index[(weak & ~kept)[labels]]] = True
        if not kept.any():
            return None
        if not kept.all():
            inside, numbers = kept[labels], np.cumsum(kept) - 1
            index, labels, sums = index[inside], numbers[labels[inside]], sums[:, kept]
            total, area, peak = sums[:3]
        share = self._n_taxels / n_pressed if is_mean else 1.0
        of_error = SD_SCALE**2 * share * error**2 if sd is None else 1.0
        k = 3 + len(self._places)
        means, deviations = sums[3:k].T, np.sqrt(of_error * sums[k:]).T
        place = place_sd = normal = None
        if k > 5:
            place, place_sd = means[:, 2:5], deviations[:, 3:6]
        if k > 8:
            lengths = np.linalg.norm(means[:, 5:], axis=1, keepdims=True)
            normal = means[:, 5:] / np.maximum(lengths, 1e-12)
        centre, centre_sd, total_sd = means[:, :2], deviations[:, 1:3], deviations[:, 0]
        one = total, total_sd, peak, centre, centre_sd, area.astype(np.intp)
        return Features(*one, place, place_sd, normal, index, labels)


def components(
    forces: Floats, low: np.float32, variances: Floats, places: Doubles
) -> tuple[Indices, Indices, Doubles]:
    """Connected components of the taxels above a threshold, and their sums.

    `forces`: (n_rows, n_cols); `variances`, (n_cells,), of the forces; `places`: (k, n_cells).
    Returns the flat indices of the taxels, the number of the component of each, and rows with an
    entry for each component: total, area, peak, k centres, variance of the total, and by the delta
    method those of the centres.
    """
    from scipy import ndimage  # half the time of the start of a process: only where it is used

    grid, n = ndimage.label(forces > low, NEIGHBOURS)
    index = np.flatnonzero(grid)
    labels = grid.reshape(-1)[index].astype(np.intp) - 1
    values = forces.reshape(-1)[index].astype(np.float64)
    here, of_each = places[:, index], variances[index].astype(np.float64)

    def summed(numbers: Doubles) -> Doubles:
        return np.array([np.bincount(labels, row, n) for row in numbers])

    total, area, variance = summed(np.stack([values, np.ones(index.size), of_each]))
    peak = np.zeros(n)
    np.maximum.at(peak, labels, values)
    means = summed(values * here) / total
    apart = summed(of_each * np.square(here - means[:, labels])) / total**2
    return index, labels, np.stack([total, area, peak, *means, variance, *apart])


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
    high: float = AT_ONCE * Limits.high,
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

    Raises
    ------
    SolverError
        If forces or error are none of these.

    Examples
    --------
    >>> import numpy as np, sparseskin
    >>> forces = np.zeros((16, 16), dtype=np.float32)
    >>> forces[4:7, 8:10] = 0.5
    >>> found = sparseskin.find_contacts(forces, error=0.014)
    >>> found.total.tolist(), found.centre.tolist(), found.area.tolist()
    ([3.0], [[5.0, 8.5]], [6])
    """
    forces = real_floats(forces, "find_contacts: forces", SolverError)
    if forces.ndim != 2 or not np.isfinite(forces).all() or not error > 0:
        raise SolverError(
            f"find_contacts: forces of shape {forces.shape} and error {error:g}; allowed: finite "
            "forces of shape (n_rows, n_cols), and an error above 0"
        )
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
