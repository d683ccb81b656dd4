"""Contacts followed from frame to frame: their ids, velocities and events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from sparseskin.messages import SkinState
from sparseskin.messages.contacts import BEGIN, END, OVER, SLIDE
from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices

from .contacts import HELD, ContactFinder, Features, Limits, overlaps

GATE = 4.0
"""Largest distance, in taxels, of a contact from the place of an earlier one that it does not
overlap with, beyond the root of its area. Chosen."""
SMOOTHING_S = 0.05
"""Time constant of the velocity, seconds. Chosen: at 1 kHz, the noise of centres, 0.02 taxels,
makes a speed of 0.4 taxels/s."""


@dataclass
class Track:
    """A contact that is followed; places are rows and columns, then x, y, z in mm if known.

    `apart`: contacts that merged into this one, and where they and it were before, by id.
    """

    id: int
    begin_ns: int
    place: Doubles
    velocity: Doubles
    over: bool = False
    sliding: bool = False
    apart: dict[int, Doubles] = field(default_factory=dict)


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

    Attributes
    ----------
    limits : Limits
        May be changed between frames.

    Notes
    -----
    Assignment: Kuhn, "The Hungarian method for the assignment problem", 1955, as of
    `scipy.optimize.linear_sum_assignment`.
    """

    def __init__(self, skin: SkinState) -> None:
        self.limits = Limits()
        self._skin = skin.skin
        self._finder = ContactFinder(self._skin)
        self.set_noise(skin)
        self._pitch_mm = 1e3 * (skin.pitch_m or 0.0)
        self._tracks: list[Track] = []
        self._map = np.zeros(skin.n_rows * skin.n_cols, dtype=np.int32)
        self._index: Indices = np.zeros(0, dtype=np.intp)
        self._last_id, self._last_ns = 0, 0

    @property
    def regions(self) -> npt.NDArray[np.int32]:
        """Number of the contact of each cell in the last frame, from 1 on, flat; 0: none."""
        return self._map

    def fits(self, skin: SkinState) -> bool:
        """True if it follows contacts on the taxels of that skin."""
        other = vars(skin.skin)
        return all(np.array_equal(value, other[name]) for name, value in vars(self._skin).items())

    def set_noise(self, skin: SkinState) -> None:
        """Take the stated noise of a skin as the least unit of the thresholds."""
        self._floor = skin.sigma_end or CONTACT_FRACTION * skin.f_max

    def update(
        self, forces: Floats, error: float | None, stamp_ns: int, sd: Floats | None = None
    ) -> Followed | None:
        """Find the contacts of the next frame; None: there are none, and nothing has ended.

        `forces`: float32 (n_rows, n_cols), 0 in masked cells; `error`: RMS error over all taxels as
        the solver estimates it; `sd`: standard deviation of each force, where known.
        """
        found = self._finder.find(
            forces,
            self._floor if error is None else error,
            self.limits,
            unit=max(self._floor, error or 0.0),
            is_mean=error is not None,
            sd=sd,
            known=self._map if self._tracks else None,
        )
        elapsed_s, self._last_ns = 1e-9 * (stamp_ns - self._last_ns), stamp_ns
        if found is None:
            if not self._tracks:
                return None
            ended = [(track.id, END) for track in self._tracks]
            self._tracks = []
            self._remember(self._index[:0], self._index[:0])
            return Followed(NOTHING, ended)
        places = found.centre
        if found.place is not None:
            places = np.concatenate([places, found.place], axis=1)
        elif self._pitch_mm:
            flat = self._pitch_mm * found.centre[:, ::-1]
            places = np.concatenate([places, flat, np.zeros((len(flat), 1))], axis=1)
        before = {track.id: track for track in self._tracks}
        ids = self._ids(found, places) if before else [0] * len(places)
        events: list[tuple[int, int]] = []
        tracks = []
        for number, place in zip(ids, places, strict=True):
            track = before.get(number)
            if track is None:
                if not number:
                    self._last_id += 1
                    number = self._last_id
                track = Track(number, stamp_ns, place, np.zeros(len(place)))
                events.append((number, BEGIN))
            elif elapsed_s > 0:
                gain = 1 - math.exp(-elapsed_s / SMOOTHING_S)
                track.velocity += gain * ((place - track.place) / elapsed_s - track.velocity)
            track.place = place
            tracks.append(track)
        now = {track.id for track in tracks}
        events += [(number, END) for number in before if number not in now]
        self._tracks = tracks
        self._remember(found.index, found.labels)
        self._note(tracks, found.total.tolist(), events)
        return Followed(self._fields(found, places, stamp_ns), events)

    def _remember(self, index: Indices, labels: Indices) -> None:
        self._map[self._index] = 0
        self._index = index
        self._map[index] = labels + 1

    def _ids(self, found: Features, places: Doubles) -> list[int]:
        """Ids of the contacts of a frame; 0: a new one."""
        tracks, n, p = self._tracks, len(found.total), len(self._tracks)
        overlap = overlaps(found.labels, self._map[found.index], n, p)
        ids = [0] * n
        if n == p == 1 and overlap[0, 0]:
            return [tracks[0].id]
        for k, q in zip(*linear_sum_assignment(overlap, maximize=True), strict=True):
            ids[k] = tracks[q].id if overlap[k, q] else 0
        by_id = {track.id: track for track in tracks}
        for q, track in enumerate(tracks):
            parts = [k for k in range(n) if ids[k] == track.id or (not ids[k] and overlap[k, q])]
            if track.apart and len(parts) > 1:
                self._part(track, parts, ids, places)
        missing = [q for q, track in enumerate(tracks) if track.id not in ids]
        for q in missing:
            into = int(overlap[:, q].argmax())
            if overlap[into, q] and ids[into] in by_id:
                kept = by_id[ids[into]]
                kept.apart.setdefault(kept.id, kept.place)
                kept.apart |= {tracks[q].id: tracks[q].place, **tracks[q].apart}
        left = [q for q in missing if not overlap[:, q].any()]
        new = [k for k in range(n) if not ids[k] and not overlap[k].any()]
        if left and new:
            centres = np.array([tracks[q].place[:2] for q in left])
            apart = np.linalg.norm(places[new, None, :2] - centres, axis=2)
            for k, q in zip(*linear_sum_assignment(apart), strict=True):
                if apart[k, q] <= GATE + math.sqrt(found.area[new[k]]):
                    ids[new[k]] = tracks[left[q]].id
        return ids

    @staticmethod
    def _part(track: Track, parts: Sequence[int], ids: list[int], places: Doubles) -> None:
        """Give the parts of merged contacts the ids that were nearest to them before."""
        known = list(track.apart)
        before = np.array([track.apart[number][:2] for number in known])
        apart = np.linalg.norm(places[parts, None, :2] - before, axis=2)
        for k in parts:
            ids[k] = 0
        for k, j in zip(*linear_sum_assignment(apart), strict=True):
            ids[parts[k]] = known[j]
            del track.apart[known[j]]
        if track.id in track.apart or len(track.apart) < 2:
            track.apart.clear()

    def _note(
        self, tracks: Sequence[Track], totals: Sequence[float], events: list[tuple[int, int]]
    ) -> None:
        """Note which contacts exceed the stated force and speed."""
        limits = self.limits
        for track, total in zip(tracks, totals, strict=True):
            track.over, begins = _switched(track.over, total, limits.over)
            if begins:
                events.append((track.id, OVER))
            if not math.isinf(limits.slide):
                velocity = track.velocity[2:] if len(track.velocity) > 2 else track.velocity
                speed = math.sqrt(float(velocity @ velocity))
                track.sliding, begins = _switched(track.sliding, speed, limits.slide)
                if begins:
                    events.append((track.id, SLIDE))

    def _fields(self, found: Features, places: Doubles, stamp_ns: int) -> dict[str, Any]:
        """Fields of the message."""
        tracks = self._tracks
        velocities = np.array([track.velocity for track in tracks], dtype=np.float32)
        ages = [1e-9 * max(0, stamp_ns - track.begin_ns) for track in tracks]
        fields: dict[str, Any] = {
            "id": np.array([track.id for track in tracks], dtype=np.int32),
            "total": found.total.astype(np.float32),
            "total_sd": found.total_sd.astype(np.float32),
            "peak": found.peak.astype(np.float32),
            "centre": found.centre.astype(np.float32),
            "centre_sd": found.centre_sd.astype(np.float32),
            "area": found.area.astype(np.int32),
            "velocity": np.ascontiguousarray(velocities[:, :2]),
            "age_s": np.array(ages, dtype=np.float32),
            "over": np.array([track.over for track in tracks], dtype=np.bool_),
            "sliding": np.array([track.sliding for track in tracks], dtype=np.bool_),
        }
        if places.shape[1] > 2:
            fields["place_mm"] = places[:, 2:].astype(np.float32)
            fields["velocity_mm_s"] = np.ascontiguousarray(velocities[:, 2:])
            place_sd = found.place_sd
            if place_sd is None:
                place_sd = np.zeros((len(places), 3))
                place_sd[:, :2] = self._pitch_mm * found.centre_sd[:, ::-1]
            fields["place_sd_mm"] = place_sd.astype(np.float32)
        if self._pitch_mm:
            fields["area_mm2"] = (self._pitch_mm**2 * found.area).astype(np.float32)
        if found.normal is not None:
            fields["normal"] = found.normal.astype(np.float32)
        return fields


def _switched(was: bool, value: float, limit: float) -> tuple[bool, bool]:
    """State of an event with hysteresis, and True if it begins."""
    now = value > (HELD * limit if was else limit)
    return now, now and not was


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
