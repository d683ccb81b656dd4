"""Contacts followed from frame to frame: their ids, velocities and events."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from sparseskin.messages import SkinState
from sparseskin.messages.contacts import BEGIN, END, OVER, SLIDE, TOUCH
from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Integers

from .contacts import (
    AREA,
    HELD,
    NORMAL,
    PEAK,
    PLACE,
    TOTAL,
    ContactFinder,
    Found,
    Limits,
    deviation_row,
)
from .first_touch import UNKNOWN, Touch

GATE = 4.0
"""Largest distance, in taxels, of a contact from the place of an earlier one that it does not
overlap with, beyond the root of its area. Chosen."""
EARLY = 3
"""First frames of each row subset in which no contact begins: the noise is known from the second
one on. Chosen: on 40 x 40 untouched taxels whose noise is not stated, N/3 to N/16, forces are up to
700 units in the first 2 P frames, and up to 3.8 later, where P is the number of subsets."""
SMOOTHING_S = 0.05
"""Time constant of the velocity, seconds. Chosen: at 1 kHz, the noise of centres, 0.02 taxels,
makes a speed of 0.4 taxels/s."""


class Tracks:
    """The contacts of a frame, of some ids. Rows of `state`, with a column for each contact: age,
    s; 1 where it is over the stated force; 1 where it slides; `velocities`, and `places`: row and
    column, then x, y, z in mm if known.
    """

    def __init__(self, ids: list[int], state: Doubles) -> None:
        self.ids = ids
        self.state = state
        self.age_s, self.over, self.sliding = state[:3]
        # As many velocities as places: the rest of the rows in two halves.
        self.velocities, self.places = np.split(state[3:], 2)

    def of(self, ids: list[int], places: Doubles) -> "Tracks":
        """Contacts of other ids; those that are not among these begin now, at some places."""
        # As in nearly all frames.
        if ids == self.ids:
            return self
        # Age and two flags, then velocities and places.
        n_rows = 3 + 2 * len(places)
        tracks = Tracks(ids, np.zeros((n_rows, len(ids))))
        tracks.places[:] = places
        for k, contact_id in enumerate(ids):
            if contact_id in self.ids:
                column = self.ids.index(contact_id)
                tracks.state[:, k] = self.state[:, column]
        return tracks


@dataclass(frozen=True)
class Followed:
    """Contacts of a frame of one patch: fields of a `Contacts` by name, and events, rows of id and
    number of the event.
    """

    fields: dict[str, Any]
    events: list[tuple[int, int]]


class ContactTracker:
    """Finds the contacts of each frame of a patch, and gives them the ids of the frame before.

    A contact is the one before that it overlaps with most; one that overlaps with none is the
    nearest of those that are left, within `GATE`. Where two meet, the one that overlaps more goes
    on and the other one ends; where they part, the parts have the ids that were nearest to them
    when they met.

    Parameters
    ----------
    skin : SkinState
        Its stated noise is the least unit of the thresholds; where it states none, 0.4 % of the
        range is.
    fast : str
        Use of the compiled loop, as in `use_compiled`.

    Attributes
    ----------
    limits : Limits
        May be changed between frames.

    Notes
    -----
    Assignment: Kuhn, "The Hungarian method for the assignment problem", 1955, as of
    `scipy.optimize.linear_sum_assignment`.
    """

    def __init__(self, skin: SkinState, fast: str = "auto") -> None:
        self.limits = Limits()
        self._skin = skin.skin
        self._finder = ContactFinder(self._skin, fast)
        self.set_noise(skin)
        pitch_mm = 1e3 * (skin.pitch_m or 0.0)
        self._cell_mm2 = np.float32(pitch_mm**2)
        self._tracks = _NO_TRACKS
        #: Of contacts that met: where they were before, by id, by the id of the one that goes on.
        self._apart: dict[int, dict[int, Doubles]] = {}
        self._last_id = 0
        self._last_ns = 0
        self._n_early = 0

    @property
    def regions(self) -> Integers:
        """Number of the contact of each cell in the last frame, from 1 on, flat; 0: none."""
        return self._finder.regions

    @property
    def in_contact(self) -> bool:
        """True if there is a contact in the last frame."""
        return bool(self._tracks.ids)

    def fits(self, skin: SkinState) -> bool:
        """True if it follows contacts on the taxels of that skin."""
        theirs = vars(skin.skin)
        ours = vars(self._skin)
        return all(np.array_equal(ours[name], theirs[name]) for name in ours)

    def set_noise(self, skin: SkinState) -> None:
        """Take the stated noise of a skin as the least unit of the thresholds."""
        self._floor = skin.sigma_end or CONTACT_FRACTION * skin.f_max

    def settle(self, n_subsets: int) -> None:
        """Let no contact begin in the next frames, in which a solver of so many row subsets learns
        the noise.
        """
        self._n_early = EARLY * n_subsets

    def update(
        self,
        forces: Floats,
        error: float | None,
        stamp_ns: int,
        sd: Floats | None = None,
        common: float = 0.0,
        touch: Touch = UNKNOWN,
    ) -> Followed | None:
        """Find the contacts of the next frame; None: there are none, and nothing has ended.

        On an untouched patch none begins; in the first frames of a touch each begins at once.

        `forces`: float32 (n_rows, n_cols), 0 in masked cells; `error`: RMS error over all taxels as
        the solver estimates it; `sd`: standard deviation of each force, where known; `common`:
        relative error that all forces share; `touch`: what the measurements of the frame show.
        """
        followed = self._follow(forces, error, stamp_ns, sd, common, touch)
        if not touch.begins:
            return followed
        # It is of the patch, and has no id.
        if followed is None:
            followed = Followed(NOTHING, [])
        followed.events.insert(0, (0, TOUCH))
        return followed

    def _follow(
        self,
        forces: Floats,
        error: float | None,
        stamp_ns: int,
        sd: Floats | None,
        common: float,
        touch: Touch,
    ) -> Followed | None:
        """As `update`, without the event of the touch."""
        elapsed_s = 1e-9 * (stamp_ns - self._last_ns)
        self._last_ns = stamp_ns
        regions = self._finder.find(
            forces,
            self._floor if error is None else error,
            self._limits_of_frame(touch),
            unit=max(self._floor, error or 0.0),
            is_mean=error is not None,
            sd=sd,
            common=common,
        )
        if regions is None:
            return self._end()

        earlier = self._tracks
        # Row and column, and x, y, z where the skin has places; normals are none.
        end_of_means = deviation_row(regions.sums)
        places = regions.sums[PLACE : min(NORMAL, end_of_means)]
        ids = self._ids(regions, places)
        for k, contact_id in enumerate(ids):
            if not contact_id:
                self._last_id += 1
                ids[k] = self._last_id
        # A part that leaves a merged contact begins again, too.
        begun = [contact_id for contact_id in ids if contact_id not in earlier.ids]
        ended = [contact_id for contact_id in earlier.ids if contact_id not in ids]
        events = [(contact_id, BEGIN) for contact_id in begun]
        events += [(contact_id, END) for contact_id in ended]

        # A recording that is played again may go back in time: no contact gets younger.
        earlier.age_s += max(0.0, elapsed_s)
        tracks = earlier.of(ids, places)
        self._tracks = tracks
        _move(tracks, places, elapsed_s)

        limits = self.limits
        if not math.isinf(limits.over):
            begins = _switch(tracks.over, regions.sums[TOTAL], limits.over)
            events += [(ids[k], OVER) for k in begins]
        # The last three velocities are in mm/s; without a pitch there are two, in taxels/s.
        if not math.isinf(limits.slide):
            velocities = tracks.velocities[-3:]
            speeds = np.linalg.norm(velocities, axis=0)
            begins = _switch(tracks.sliding, speeds, limits.slide)
            events += [(ids[k], SLIDE) for k in begins]

        for merged in self._apart.keys() - set(ids):
            del self._apart[merged]
        return Followed(self._fields(regions.sums), events)

    def _limits_of_frame(self, touch: Touch) -> Limits:
        """Limits of the next frame: where no contact begins, no force is high enough."""
        is_early = self._n_early > 0
        self._n_early -= is_early
        if is_early or touch.touched is False:
            return replace(self.limits, high=math.inf)
        if touch.is_new and not self.in_contact:
            self._finder.expect()
        return self.limits

    def rest(self, until_ns: int) -> None:
        """Let contacts rest where they are until a stamp."""
        elapsed_s = max(0.0, 1e-9 * (until_ns - self._last_ns))
        self._last_ns = until_ns
        self._tracks.age_s += elapsed_s
        self._tracks.velocities *= math.exp(-elapsed_s / SMOOTHING_S)

    def _end(self) -> Followed | None:
        """The end of all contacts; None if there were none."""
        ended = self._tracks.ids
        if not ended:
            return None
        self._tracks = _NO_TRACKS
        self._apart = {}
        return Followed(NOTHING, [(contact_id, END) for contact_id in ended])

    def _ids(self, regions: Found, places: Doubles) -> list[int]:
        """Ids of the contacts of a frame; 0: a new one."""
        tracks = self._tracks
        ids = [0] * places.shape[1]
        if not tracks.ids:
            return ids

        # Contacts and earlier ones that overlap, which is one to one in nearly all frames.
        pairs = np.argwhere(regions.overlap).tolist()
        overlapping = {k for k, _ in pairs}
        overlapped = {q for _, q in pairs}
        if len(overlapping) == len(overlapped) == len(pairs):
            for k, q in pairs:
                ids[k] = tracks.ids[q]
        else:
            self._meet_and_part(regions.overlap, ids, places)

        # Fast ones overlap with none: the nearest ones are the same contact.
        alone = [k for k in range(len(ids)) if k not in overlapping]
        gone = [q for q in range(len(tracks.ids)) if q not in overlapped]
        spots = [tracks.places[:2, q] for q in gone]
        for k, q, distance in _nearest(alone, places, spots):
            # A large one moves as far in its own size.
            side = math.sqrt(regions.sums[AREA, k])
            if distance <= GATE + side:
                ids[k] = tracks.ids[gone[q]]
        return ids

    def _meet_and_part(self, overlap: Indices, ids: list[int], places: Doubles) -> None:
        """Set the ids of contacts of which some overlap with several, or are overlapped by some."""
        tracks = self._tracks
        pairs = linear_sum_assignment(overlap, maximize=True)
        for k, q in zip(*pairs, strict=True):
            # Of more contacts than overlap, some are paired all the same.
            if overlap[k, q]:
                ids[k] = tracks.ids[q]

        # Contacts that had met part: the one that went on, and new ones where it was.
        for q, merged in enumerate(tracks.ids):
            if merged not in self._apart:
                continue
            parts = []
            for k, contact_id in enumerate(ids):
                if contact_id == merged or (not contact_id and overlap[k, q]):
                    parts.append(k)
            if len(parts) > 1:
                self._part(merged, parts, ids, places)

        # Others meet: one goes on, and keeps the places of both, and of those they had met.
        for q, met in enumerate(tracks.ids):
            into = int(overlap[:, q].argmax())
            merged = ids[into]
            meets = overlap[into, q] > 0 and merged in tracks.ids
            if met in ids or not meets:
                continue
            column = tracks.ids.index(merged)
            place = tracks.places[:2, column]
            places_of_parts = self._apart.setdefault(merged, {})
            places_of_parts.setdefault(merged, place)
            places_of_parts[met] = tracks.places[:2, q]
            places_of_parts.update(self._apart.get(met, {}))

    def _part(
        self, merged: int, parts: Sequence[int], ids: list[int], places: Doubles
    ) -> None:
        """Give the parts of merged contacts the ids that were nearest to them before."""
        places_of_parts = self._apart[merged]
        ids_before = list(places_of_parts)
        nearest = _nearest(parts, places, list(places_of_parts.values()))
        for k in parts:
            ids[k] = 0
        for k, j, _ in nearest:
            ids[k] = ids_before[j]
            del places_of_parts[ids_before[j]]
        # Of fewer than two that are still together, none can part.
        if merged in places_of_parts or len(places_of_parts) < 2:
            del self._apart[merged]

    def _fields(self, sums: Doubles) -> dict[str, Any]:
        """Fields of the message."""
        # One conversion of all numbers: of a few contacts each call takes as long as the numbers.
        n = len(sums)
        end_of_means = deviation_row(sums)
        doubles = np.concatenate([sums, self._tracks.state])
        floats = doubles.astype(np.float32)
        means = floats[PLACE:end_of_means]
        deviations = floats[end_of_means:n]
        age_s, over, sliding = floats[n : n + 3]
        velocities = floats[n + 3 :]
        fields: dict[str, Any] = {
            "id": np.array(self._tracks.ids, dtype=np.int32),
            "total": floats[TOTAL],
            "total_sd": deviations[0],
            "peak": floats[PEAK],
            "centre": means[:2].T.copy(),
            "centre_sd": deviations[1:3].T.copy(),
            "area": floats[AREA].astype(np.int32),
            "velocity": velocities[:2].T.copy(),
            "age_s": age_s,
            "over": over > 0,
            "sliding": sliding > 0,
        }
        if len(means) > 2:
            fields["place_mm"] = means[2:5].T.copy()
            fields["velocity_mm_s"] = velocities[2:5].T.copy()
            fields["place_sd_mm"] = deviations[3:6].T.copy()
        if self._cell_mm2:
            fields["area_mm2"] = floats[AREA] * self._cell_mm2
        if len(means) > 5:
            fields["normal"] = means[5:].T.copy()
        return fields


def _move(tracks: Tracks, places: Doubles, elapsed_s: float) -> None:
    """Set the places of contacts, and let their velocities follow by a first-order filter."""
    # Of the gain by elapsed time, so that they settle in as long at any rate of frames.
    if elapsed_s > 0:
        gain = 1 - math.exp(-elapsed_s / SMOOTHING_S)
        tracks.velocities *= 1 - gain
        tracks.velocities += (gain / elapsed_s) * (places - tracks.places)
    tracks.places[:] = places


def _nearest(
    contacts: Sequence[int], places: Doubles, spots: Sequence[Doubles]
) -> Iterator[tuple[int, int, float]]:
    """Pairs of contacts and spots that are nearest in sum, and each distance, in taxels."""
    if not contacts or not spots:
        return
    targets = [spot.tolist() for spot in spots]
    distances = []
    for k in contacts:
        centre = places[:2, k]
        distances.append([math.dist(centre, target) for target in targets])
    pairs = linear_sum_assignment(distances)
    for row, q in zip(*pairs, strict=True):
        yield contacts[row], q, distances[row][q]


def _switch(state: Doubles, values: Doubles, limit: float) -> Iterator[int]:
    """Update the state of an event, with hysteresis; yield the contacts where it begins."""
    was_on = state.tolist()
    for k, value in enumerate(values.tolist()):
        bound = limit
        if was_on[k]:
            bound = HELD * limit
        state[k] = value > bound
        if state[k] and not was_on[k]:
            yield k


_NO_TRACKS = Tracks([], np.zeros((5, 0)))
_EMPTY = np.zeros(0, dtype=np.float32)
_EMPTY_2 = np.zeros((0, 2), dtype=np.float32)
NOTHING: dict[str, Any] = {
    "id": np.zeros(0, dtype=np.int32),
    **dict.fromkeys(("total", "total_sd", "peak", "age_s"), _EMPTY),
    **dict.fromkeys(("centre", "centre_sd", "velocity"), _EMPTY_2),
    "area": np.zeros(0, dtype=np.int32),
    **dict.fromkeys(("over", "sliding"), np.zeros(0, dtype=np.bool_)),
}
"""Fields of a frame without contacts."""


def joined(followed: Sequence[Followed | None]) -> dict[str, Any]:
    """Fields of a `Contacts` of several patches, by their contacts, in the order of the patches."""
    numbers = []
    touched = []
    events = []
    for k, patch in enumerate(followed):
        if patch is None:
            continue
        events += [(k, *event) for event in patch.events]
        n_contacts = patch.fields["id"].size
        if n_contacts:
            touched.append(patch.fields)
            numbers += n_contacts * [k]

    # That of one patch, the usual case, is not copied.
    fields = dict(NOTHING)
    if len(touched) == 1:
        fields = dict(touched[0])
    elif touched:
        for name in touched[0]:
            fields[name] = np.concatenate([columns[name] for columns in touched])
    if len(followed) > 1:
        fields["patch_of"] = np.array(numbers, dtype=np.int32)
    if events:
        fields["events"] = np.array(events, dtype=np.int32)
    return fields
