"""Contacts followed from frame to frame: their ids, velocities and events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from sparseskin.messages import SkinState
from sparseskin.messages.contacts import BEGIN, END, OVER, SLIDE
from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask

from .contacts import HELD, ContactFinder, Found, Limits

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


class Tracks(NamedTuple):
    """The contacts of a frame, an entry or column each; the rows of places and velocities are row
    and column, then x, y, z in mm if known.
    """

    ids: list[int]
    begins_ns: Indices
    places: Doubles
    velocities: Doubles
    over: Mask
    sliding: Mask

    def of(self, ids: list[int], places: Doubles, now_ns: int) -> Tracks:
        """These contacts in the order of some ids; those that are not among them begin now."""
        if ids == self.ids:
            return self
        made = Tracks(
            ids,
            np.full(len(ids), now_ns, dtype=np.intp),
            places.copy(),
            np.zeros_like(places),
            *np.zeros((2, len(ids)), dtype=np.bool_),
        )
        old = [k for k, one in enumerate(ids) if one in self.ids]
        rows = [self.ids.index(ids[k]) for k in old]
        for one, other in zip(made[1:], self[1:], strict=True) if old else ():
            one[..., old] = other[..., rows]
        return made


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
        self._pitch_mm = 1e3 * (skin.pitch_m or 0.0)
        self._tracks = _NO_TRACKS
        #: Of contacts that met: where they were before, by id, by the id of the one that goes on.
        self._apart: dict[int, dict[int, Doubles]] = {}
        self._last_id, self._last_ns, self._n_early = 0, 0, 0

    @property
    def regions(self) -> npt.NDArray[np.int32]:
        """Number of the contact of each cell in the last frame, from 1 on, flat; 0: none."""
        return self._finder.regions

    def fits(self, skin: SkinState) -> bool:
        """True if it follows contacts on the taxels of that skin."""
        other = vars(skin.skin)
        return all(np.array_equal(value, other[name]) for name, value in vars(self._skin).items())

    def set_noise(self, skin: SkinState) -> None:
        """Take the stated noise of a skin as the least unit of the thresholds."""
        self._floor = skin.sigma_end or CONTACT_FRACTION * skin.f_max

    def settle(self, n_subsets: int) -> None:
        """Let no contact begin in the next frames, in which a solver of so many row subsets learns
        the noise.
        """
        self._n_early = EARLY * n_subsets

    def update(
        self, forces: Floats, error: float | None, stamp_ns: int, sd: Floats | None = None
    ) -> Followed | None:
        """Find the contacts of the next frame; None: there are none, and nothing has ended.

        `forces`: float32 (n_rows, n_cols), 0 in masked cells; `error`: RMS error over all taxels as
        the solver estimates it; `sd`: standard deviation of each force, where known.
        """
        before, limits = self._tracks, self.limits
        if self._n_early:
            self._n_early, limits = self._n_early - 1, replace(limits, high=math.inf)
        found = self._finder.find(
            forces,
            self._floor if error is None else error,
            limits,
            unit=max(self._floor, error or 0.0),
            is_mean=error is not None,
            sd=sd,
        )
        elapsed_s, self._last_ns = 1e-9 * (stamp_ns - self._last_ns), stamp_ns
        if found is None:
            if not before.ids:
                return None
            self._tracks, self._apart = _NO_TRACKS, {}
            return Followed(NOTHING, [(number, END) for number in before.ids])
        places = found.sums[3 : min(8, len(found.sums) // 2 + 1)]
        ids = self._ids(found, places) if before.ids else [0] * places.shape[1]
        for k in [k for k, one in enumerate(ids) if not one]:
            self._last_id += 1
            ids[k] = self._last_id
        events = [(one, BEGIN) for one in ids if one not in before.ids]
        events += [(one, END) for one in before.ids if one not in ids]
        _, begins_ns, was, velocities, over, sliding = before.of(ids, places, stamp_ns)
        if elapsed_s > 0:
            gain = 1 - math.exp(-elapsed_s / SMOOTHING_S)
            velocities = (1 - gain) * velocities + (gain / elapsed_s) * (places - was)
        if not math.isinf(limits.over):
            over = _switched(over, found.sums[0], limits.over, ids, OVER, events)
        if not math.isinf(limits.slide):
            speeds = np.linalg.norm(velocities[-3:], axis=0)
            sliding = _switched(sliding, speeds, limits.slide, ids, SLIDE, events)
        self._tracks = Tracks(ids, begins_ns, places, velocities, over, sliding)
        if self._apart:
            self._apart = {one: apart for one, apart in self._apart.items() if one in ids}
        return Followed(self._fields(found.sums, stamp_ns), events)

    def _ids(self, found: Found, places: Doubles) -> list[int]:
        """Ids of the contacts of a frame; 0: a new one."""
        before, overlap = self._tracks, found.overlap
        (n, p), rows = overlap.shape, overlap.tolist()
        pairs = [q for row in rows for q in range(p) if row[q]]
        if n == p == len(pairs) == len(set(pairs)) and all(map(any, rows)):
            return [before.ids[q] for q in pairs]
        ids = [0] * n
        for k, q in zip(*linear_sum_assignment(overlap, maximize=True), strict=True):
            ids[k] = before.ids[q] if overlap[k, q] else 0
        for q, one in enumerate(before.ids):
            if one in self._apart:
                parts = [k for k in range(n) if ids[k] == one or (not ids[k] and overlap[k, q])]
                if len(parts) > 1:
                    self._part(one, parts, ids, places)
        missing = [q for q, one in enumerate(before.ids) if one not in ids]
        for q in missing:
            into = int(overlap[:, q].argmax())
            if overlap[into, q] and ids[into] in before.ids:
                one, other = ids[into], before.ids[q]
                apart = self._apart.setdefault(one, {})
                apart.setdefault(one, before.places[:, before.ids.index(one)])
                apart |= {other: before.places[:, q], **self._apart.get(other, {})}
        left = [q for q in missing if not overlap[:, q].any()]
        new = [k for k in range(n) if not ids[k] and not overlap[k].any()]
        if left and new:
            distances = _distances(places[:, new], before.places[:, left])
            for k, q in zip(*linear_sum_assignment(distances), strict=True):
                if distances[k, q] <= GATE + math.sqrt(found.sums[1, new[k]]):
                    ids[new[k]] = before.ids[left[q]]
        return ids

    def _part(self, one: int, parts: Sequence[int], ids: list[int], places: Doubles) -> None:
        """Give the parts of merged contacts the ids that were nearest to them before."""
        apart = self._apart[one]
        known = list(apart)
        distances = _distances(places[:, parts], np.array([*apart.values()]).T)
        for k in parts:
            ids[k] = 0
        for k, j in zip(*linear_sum_assignment(distances), strict=True):
            ids[parts[k]] = known[j]
            del apart[known[j]]
        if one in apart or len(apart) < 2:
            del self._apart[one]

    def _fields(self, sums: Doubles, stamp_ns: int) -> dict[str, Any]:
        """Fields of the message."""
        tracks, k = self._tracks, len(sums) // 2 + 1
        floats, velocities = sums.astype(np.float32, "C"), tracks.velocities.astype(np.float32)
        fields: dict[str, Any] = {
            "id": np.array(tracks.ids, dtype=np.int32),
            "total": floats[0],
            "total_sd": floats[k],
            "peak": floats[2],
            "centre": _rows(floats[3:5]),
            "centre_sd": _rows(floats[k + 1 : k + 3]),
            "area": sums[1].astype(np.int32),
            "velocity": _rows(velocities[:2]),
            "age_s": (1e-9 * np.maximum(0, stamp_ns - tracks.begins_ns)).astype(np.float32),
            "over": tracks.over,
            "sliding": tracks.sliding,
        }
        if k > 5:
            fields["place_mm"] = _rows(floats[5:8])
            fields["velocity_mm_s"] = _rows(velocities[2:])
            fields["place_sd_mm"] = _rows(floats[k + 3 : k + 6])
        if self._pitch_mm:
            fields["area_mm2"] = floats[1] * np.float32(self._pitch_mm**2)
        if k > 8:
            fields["normal"] = _rows(floats[8:k])
        return fields


def _rows(columns: Floats) -> Floats:
    """A row for each contact of arrays with a column each."""
    return np.ascontiguousarray(columns.T)


def _distances(places: Doubles, others: Doubles) -> Doubles:
    """Distances of places on the grid, (>= 2, n), from others, (>= 2, m), in taxels, (n, m)."""
    apart: Doubles = np.linalg.norm(places[:2, :, None] - others[:2, None], axis=0)
    return apart


def _switched(
    was: Mask,
    values: Doubles,
    limit: float,
    ids: Sequence[int],
    event: int,
    events: list[tuple[int, int]],
) -> Mask:
    """State of an event with hysteresis; adds it for the contacts where it begins."""
    now: Mask = values > np.where(was, HELD * limit, limit)
    events += [(ids[k], event) for k in np.flatnonzero(now & ~was).tolist()]
    return now


_NO_TRACKS = Tracks(
    [], *np.zeros((1, 0), np.intp), *np.zeros((2, 5, 0)), *np.zeros((2, 0), np.bool_)
)
_EMPTY, _EMPTY_2 = np.zeros(0, dtype=np.float32), np.zeros((0, 2), dtype=np.float32)
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
    found = [(k, one) for k, one in enumerate(followed) if one is not None]
    touched = [(k, one) for k, one in found if one.fields["id"].size]
    fields = dict(touched[0][1].fields if touched else NOTHING)
    if len(touched) > 1:
        fields = {n: np.concatenate([one.fields[n] for _, one in touched]) for n in fields}
    if len(followed) > 1:
        rows = [np.full(one.fields["id"].size, k, dtype=np.int32) for k, one in touched]
        fields["patch_of"] = np.concatenate([*rows, np.zeros(0, dtype=np.int32)])
    events = [(k, *event) for k, one in found for event in one.events]
    if events:
        fields["events"] = np.array(events, dtype=np.int32)
    return fields
