"""Contacts of a frame, found by a threshold with hysteresis."""

import math
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sparseskin.messages.errors import MessageError
from sparseskin.messages.skin import Skin
from sparseskin.nodes.arguments import checked
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import (
    LARGEST,
    Doubles,
    Floats,
    Indices,
    Integers,
    Mask,
    real_floats,
)
from sparseskin.nodes.numerics.compiled import ready, use_compiled

NEIGHBOURS = np.ones((3, 3), dtype=np.bool_)
"""A taxel and its eight neighbours on the grid; of a skin of points, on its virtual grid."""
HELD = 0.5
"""Part of the least force, and of the force and speed of an event, at which a contact ends, or the
event may come again. Chosen."""
AT_ONCE = 2.0
"""Factor on the high threshold: a contact above the product begins in its first frame. One below it
begins in the second frame in a row that exceeds the threshold itself at one place. A touch that the
measurements show counts as the first of these two frames. Chosen."""
SD_SCALE = 2.0
"""Factor on the standard deviations of independent errors, which neighbours do not have. Fitted: on
two scenes and three presses, 40 x 40 taxels, all taxels read, N/3 and N/8, the true deviations of a
total are 1.4 to 4.6 times those of independent errors (geometric mean 2.4), of a centre 0.7 to 3.1
(1.8)."""

TOTAL = 0
"""Row of the totals in `sums`, as of `components`, with a column for each contact."""
AREA = 1
"""Row of the numbers of taxels in `sums`."""
PEAK = 2
"""Row of the largest forces in `sums`."""
PLACE = 3
"""First row of the centres in `sums`: row, column; then x, y, z and a normal where known."""
NORMAL = 8
"""First row of the normals in `sums`, behind row, column, x, y, z; only of a skin of points."""


@dataclass(frozen=True)
class Limits:
    """What counts as a contact and as an event.

    `low`, `high`: thresholds of a taxel in units of its error; a contact is made of neighbours
    above the low one, of which one exceeds the high one in two frames in a row, or `AT_ONCE` times
    as much in one. `force`, `area`: least total, in the skin's unit, and least number of taxels.
    `over`: total above which an event is reported. `slide`: speed above which one is, mm/s, or
    taxels/s where no pitch is known.
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
    index, labels : ndarray of int64, shape (n_pressed,)
        Taxels of the contacts in the flat grid, and the number of the contact of each.
    """

    total: Doubles
    total_sd: Doubles
    peak: Doubles
    centre: Doubles
    centre_sd: Doubles
    area: Indices
    index: Indices
    labels: Indices


class Components(NamedTuple):
    """Connected components of a frame, n of them, as of `components`.

    `cells`: flat indices of their taxels, (n_pressed,); `labels`: number of the component of each,
    from 0 on, (n_pressed,). `sums`: (4 + 2 k, n), where k is the number of places of a cell: rows
    total, area, peak, k centres, variance of the total, and variances of the k centres. `overlap`:
    numbers of taxels in each earlier region, (n, n_regions). `n_above`: number of all taxels above
    the low threshold.
    """

    cells: Indices
    labels: Indices
    sums: Doubles
    overlap: Indices
    n_above: int


def deviation_row(sums: Doubles) -> int:
    """Row of the variance, or deviation, of the total in `sums`; those of the centres follow."""
    # Of 4 + 2 k rows, total, area, peak and k centres stand before it.
    return len(sums) // 2 + 1


class Found(NamedTuple):
    """Contacts of one frame: rows of `sums` as of `components`, with deviations in place of
    variances and unit normals; `overlap` with those of the frame before.
    """

    sums: Doubles
    overlap: Indices


class ContactFinder:
    """Finds the contacts of successive frames of one skin.

    Neighbours of a skin of points are those on its virtual grid, on which neighbours are
    neighbours on the surface. `fast`: use of the compiled loop, as in `use_compiled`. `regions`:
    number of the contact of each cell in the last frame, from 1 on, flat; 0: none.
    """

    def __init__(self, skin: Skin, fast: str = "off") -> None:
        self._n_taxels = skin.n_taxels
        self._places = _places_of(skin)
        self._alike = np.ones(self._places.shape[1], dtype=np.float32)
        #: The compiled loop returns the fields of `Components` as a plain tuple.
        self._components: Callable[..., tuple[Any, ...]] = components
        if use_compiled(fast):
            from sparseskin.nodes.numerics import kernels  # needs numba

            ready(kernels.components)
            self._components = kernels.components
        self.regions = np.zeros(self._alike.size, dtype=np.int32)
        self._n = 0
        #: Cells of what exceeded the high threshold in the last frame, but not `AT_ONCE` times.
        self._waiting: Mask | None = None

    def find(
        self,
        forces: Floats,
        error: float,
        limits: Limits,
        *,
        unit: float | None = None,
        is_mean: bool = False,
        sd: Floats | None = None,
        common: float = 0.0,
    ) -> Found | None:
        """Contacts of the next frame, float32 (n_rows, n_cols), 0 in masked cells; None: none.

        `unit` scales the thresholds; by default it is `error`. The deviations of totals and centres
        follow from `sd`, or without it from `error`. `error`, `unit` and `sd` have the unit of the
        forces.

        `error`: RMS error of a taxel. `is_mean`: it is the mean over all taxels of the skin, of
        which those that are 0 have no error. `sd`: standard deviation of each force, (n_rows,
        n_cols). `common`: relative error that all forces share, which totals have beside that.

        What overlaps most with a contact of the frame before stays a contact above the low
        threshold, with half of the least force.
        """
        unit = error if unit is None else unit
        high = limits.high * unit
        n_before = self._n
        waiting = self._waiting
        self._waiting = None
        # Nearly all frames of an untouched skin: nothing can begin, and nothing is there.
        if not n_before and float(forces.max()) <= high:
            return None

        forces = np.ascontiguousarray(forces, dtype=np.float32)
        variances = self._alike
        if sd is not None:
            variances = np.square(sd, dtype=np.float32).reshape(-1)
        # The compiled loop takes these types alone. `low` is compared with each force, in float32;
        # `high` also with peaks of float64.
        components_of_frame = self._components(
            forces,
            np.float32(limits.low * unit),
            high,
            variances,
            self._places,
            self.regions,
            n_before,
        )
        index, labels, sums, overlap, n_above = components_of_frame
        waited: set[int] = set()
        if waiting is not None:
            waited.update(labels[waiting[index]].tolist())
        contacts, candidates = _contacts_among(sums, overlap, high, limits, waited)
        if len(contacts) < sums.shape[1]:
            self._leave_out(index, labels, contacts, candidates, sums.shape[1])
            sums = sums[:, contacts]
            overlap = overlap[contacts]
        self._n = len(contacts)
        if not contacts:
            return None

        # Without `sd` the variances were 1: they become that of the error. That of a mean over the
        # skin is larger in the taxels that are not 0, as the others have none.
        scale = SD_SCALE**2
        if sd is None:
            if is_mean:
                scale *= self._n_taxels / n_above
            scale *= error**2
        self._complete(sums, scale, common)
        return Found(sums, overlap)

    def _complete(self, sums: Doubles, scale: float, common: float) -> None:
        """Turn variances, times a scale, into standard deviations, of which an error that all
        forces share adds to that of the total; and normals into unit vectors.
        """
        variance_row = deviation_row(sums)
        deviations = sums[variance_row:]
        np.sqrt(scale * deviations, out=deviations)
        np.hypot(deviations[0], common * sums[TOTAL], out=deviations[0])
        if variance_row > NORMAL:
            normals = sums[NORMAL:variance_row]
            lengths = np.linalg.norm(normals, axis=0)
            # Those of a surface that turns within a contact may cancel.
            normals /= np.maximum(lengths, 1e-12)

    def expect(self) -> None:
        """Let contacts of the next frame begin at once: their measurements show a touch."""
        self._waiting = np.ones(self.regions.size, dtype=np.bool_)

    def _leave_out(
        self,
        index: Indices,
        labels: Indices,
        contacts: Sequence[int],
        candidates: Sequence[int],
        n_components: int,
    ) -> None:
        """Number the cells by contact, and let those of candidates wait for the next frame."""
        number_of_component = np.zeros(n_components, dtype=np.int32)
        number_of_component[contacts] = np.arange(1, len(contacts) + 1)
        self.regions[index] = number_of_component[labels]
        if candidates:
            waits = np.isin(labels, candidates)
            self._waiting = np.zeros(self.regions.size, dtype=np.bool_)
            self._waiting[index[waits]] = True


def _places_of(skin: Skin) -> Doubles:
    """Row and column of each cell; then x, y, z in mm, where they are known; then the normal, of a
    skin of points.
    """
    numbers = np.arange(skin.n_rows * skin.n_cols)
    rows_and_cols = np.divmod(numbers, skin.n_cols)
    places = np.array(rows_and_cols, dtype=np.float64)
    if skin.points is not None:
        points = np.zeros((6, places.shape[1]))
        points[:, skin.exists.reshape(-1)] = skin.points.T
        points[:3] *= 1e3
        return np.concatenate([places, points])
    if skin.pitch_m is not None:
        # x runs along the columns, y along the rows.
        x_y = 1e3 * skin.pitch_m * places[::-1]
        z = np.zeros_like(x_y[:1])
        return np.concatenate([places, x_y, z])
    return places


def _contacts_among(
    sums: Doubles, overlap: Indices, high: float, limits: Limits, waited: Set[int]
) -> tuple[list[int], list[int]]:
    """The components that are contacts, and those that are if they are there in the next frame.

    `sums` and `overlap` as of `components`; `waited`: the candidates of the frame before.
    """
    # Each contact of the frame before goes on in the component that it overlaps with most.
    continued = set()
    for of_earlier in overlap.T.tolist():
        if any(of_earlier):
            continued.add(of_earlier.index(max(of_earlier)))
    # What goes on needs half of the force alone, so that a contact at the limit does not flicker.
    contacts = []
    candidates = []
    for component, (total, area, peak) in enumerate(sums[:PLACE].T.tolist()):
        fits = total >= limits.force and area >= limits.area and peak > high
        goes_on = component in continued and total >= HELD * limits.force
        begins = fits and (peak > AT_ONCE * high or component in waited)
        if goes_on or begins:
            contacts.append(component)
        elif fits:
            candidates.append(component)
    return contacts, candidates


def components(
    forces: Floats,
    low: np.float32,
    high: float,
    variances: Floats,
    places: Doubles,
    regions: Integers,
    n_regions: int,
) -> Components:
    """Connected components of the taxels above `low` of which one exceeds `high`, or lies in an
    earlier region, and their sums.

    `forces`: (n_rows, n_cols); `variances`, (n_cells,), of the forces; `places`: (k, n_cells);
    `regions`: (n_cells,), from 1 to `n_regions`, or 0; it becomes that of the components. Variances
    of the centres are those of the delta method.
    """
    # Half the time of the start of a process: it is imported only where it is used.
    from scipy import ndimage

    grid, n = ndimage.label(forces > low, NEIGHBOURS)
    index = np.flatnonzero(grid)
    n_above = int(index.size)
    labels = grid.reshape(-1)[index].astype(np.intp) - 1
    peak = np.zeros(n)
    np.maximum.at(peak, labels, forces.reshape(-1)[index])

    # Components that are neither high enough nor in an earlier region are left out.
    in_earlier = np.bincount(labels, regions[index], n) > 0
    is_contact = (peak > high) | in_earlier
    number_of_component = np.cumsum(is_contact) - 1
    is_in_contact = is_contact[labels]
    index = index[is_in_contact]
    labels = number_of_component[labels[is_in_contact]]
    peak = peak[is_contact]
    n = np.count_nonzero(is_contact)

    values = forces.reshape(-1)[index].astype(np.float64)
    places_of_taxels = places[:, index]
    of_each = variances[index].astype(np.float64)

    def summed(numbers: Doubles) -> Doubles:
        return np.array([np.bincount(labels, row, n) for row in numbers])

    ones = np.ones(index.size)
    total, area, variance = summed(np.stack([values, ones, of_each]))
    means = summed(values * places_of_taxels) / total
    lever = places_of_taxels - means[:, labels]
    squared_lever = np.square(lever)
    spread = summed(of_each * squared_lever) / total**2

    # A column for each region, of which 0 is none.
    n_columns = n_regions + 1
    pairs = labels * n_columns + regions[index]
    counts = np.bincount(pairs, minlength=n * n_columns)
    overlap = counts.reshape(n, n_columns)[:, 1:]
    regions.fill(0)
    regions[index] = labels + 1
    sums = np.stack([total, area, peak, *means, variance, *spread])
    return Components(index, labels, sums, overlap, n_above)


@checked(SolverError)
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
        Errors of neighbours count as dependent with either.
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
    # Not `>`: NaN is no force, either.
    forces = real_floats(forces, "find_contacts: forces", SolverError)
    is_finite = bool((np.abs(forces) <= LARGEST).all())
    if forces.ndim != 2 or not is_finite or not error > 0:
        raise SolverError(
            f"find_contacts: forces of shape {forces.shape} and error {error:g}; allowed: forces "
            f"of shape (n_rows, n_cols) within +-{LARGEST:g}, and an error above 0"
        )
    n_rows, n_cols = forces.shape
    exists = None if mask is None else np.asarray(mask)
    try:
        skin = Skin(n_rows, n_cols, f_max=1.0, mask=exists)
    except MessageError as cause:
        raise SolverError(f"find_contacts: {cause}") from cause
    if sd is not None:
        sd = real_floats(sd, "find_contacts: sd", SolverError)
        if sd.shape != forces.shape or not (sd >= 0).all():
            raise SolverError(
                f"find_contacts: sd of shape {sd.shape}; allowed: 0 or more, of shape "
                f"{forces.shape}, as the forces"
            )
    forces = np.where(skin.exists, forces, np.float32(0))
    # There is no second frame. In the first one a contact begins above `AT_ONCE` times the high
    # threshold of `Limits`, which is then the one stated here.
    limits = Limits(low, high / AT_ONCE, force, area)
    finder = ContactFinder(skin)
    contacts = finder.find(forces, error, limits, is_mean=is_mean, sd=sd)
    # Without a pitch the places are row and column alone.
    n_places = 2
    sums = np.zeros((4 + 2 * n_places, 0))
    if contacts is not None:
        sums = contacts.sums
    total_sd, *centre_sd = sums[deviation_row(sums) :]
    index = np.flatnonzero(finder.regions)
    return Features(
        total=sums[TOTAL],
        total_sd=total_sd,
        peak=sums[PEAK],
        centre=np.ascontiguousarray(sums[PLACE : PLACE + n_places].T),
        centre_sd=np.stack(centre_sd, axis=1),
        area=sums[AREA].astype(np.intp),
        index=index,
        labels=finder.regions[index].astype(np.intp) - 1,
    )
