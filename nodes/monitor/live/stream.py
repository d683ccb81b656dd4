"""Stream of the live page: records of a JSON header and the bytes of its arrays.

A record is two little-endian 32-bit counts, of header bytes and of data bytes, then both. The
header's "arrays" lists [name, dtype, shape] of the arrays that follow one another in the data.
"""

import json
import math
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sparseskin.messages import Reconstruction
from sparseskin.messages.contacts import sum_unit
from sparseskin.messages.reasons import phrase_of, sentence_of
from sparseskin.nodes.numerics.arrays import TINY
from sparseskin.nodes.process.control import Document

from .feed import Feed, PatchFeed
from .notices import Notices, host_lines

FRAME_S = 1 / 30
"""Pages are drawn 30 times a second."""
OVERVIEW_S = 0.1
"""Time between two maps of a patch in an overview of up to `FULL_RATE`, seconds."""
FULL_RATE = 32
"""Patches of an overview that is drawn 10 times a second; one of more is drawn less often."""
STATE_S = 0.1
"""Time between two states, seconds: ages on the page count on by tenths."""
MOST = 16
"""Contacts of a patch that are sent: the strongest ones."""
CONTACT_FIELDS = (
    *("id", "total", "total_sd", "centre", "area", "velocity"),
    *("age_s", "over", "sliding"),
    *("place_mm", "area_mm2", "velocity_mm_s", "normal"),
)
SKIN_FIELDS = (
    *("n_rows", "n_cols", "f_max", "unit", "pitch_m", "source", "rate_hz"),
    *("has_truth", "has_taxels", "sigma_end"),
)
LABEL = ("label", "share", "age_s", "trusted")
SLACK_S = 0.005
"""A frame that is early by at most this time is sent, not delayed by another period."""

Arrays = dict[str, np.ndarray[Any, Any]]
Part = tuple[Document, Arrays]
"""A record before it is encoded: its header and its arrays by their names."""


def record(header: Mapping[str, Any], arrays: Arrays) -> bytes:
    """One record as bytes; numbers that are not finite become null in the header."""
    # A page reads arrays by these, one after the other, from the data.
    forms = []
    data = b""
    for name, array in arrays.items():
        shape = list(array.shape)
        forms.append([name, array.dtype.str, shape])
        data += np.ascontiguousarray(array).tobytes()
    body = finite({**header, "arrays": forms})
    head = json.dumps(body, separators=(",", ":")).encode()
    counts = struct.pack("<II", len(head), len(data))
    return counts + head + data


def finite(value: Any) -> Any:
    """The value with None in place of numbers that are not finite."""
    # JSON has neither NaN nor infinity: a browser refuses what Python writes for them.
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [finite(part) for part in value]
    return value


class StreamReader:
    """Reader of a feed for one page: sends each record once, and only the newest maps.

    `patch` is shown with all its maps and figures; None: an overview of all patches.
    """

    def __init__(self, feed: Feed, notices: Notices, patch: str | None) -> None:
        self._feed = feed
        self._notices = notices
        self._patch = patch
        # So that an overview costs no more than one of `FULL_RATE` patches.
        n_rounds = max(1.0, len(feed.patches) / FULL_RATE)
        self._period_s = OVERVIEW_S * n_rounds
        self._names = list(feed.patches)
        if patch is not None:
            self._period_s = FRAME_S
            self._names = [patch]
        # What has been sent already: numbers of maps and of rows, and objects by a name.
        self._n_maps = dict.fromkeys(feed.patches, -1)
        self._n_rows = {"rows": 0, "events": 0}
        self._n_answers = feed.n_answers
        self._sent: Document = {}
        self._frame_due_s = -math.inf
        self._state_at_s = -math.inf

    def records(self) -> Iterator[bytes]:
        """Yield records until the feed is closed; waits for new data between them."""
        closed = False
        while not closed:
            with self._feed.changed:
                self._wait()
                closed = self._feed.closed
                parts = list(self._collect(time.monotonic(), closed))
            # Encoding and sending are done without the lock, so that no other page waits.
            yield b"".join(record(header, arrays) for header, arrays in parts)

    def _wait(self) -> None:
        """Wait until there is something to send."""
        feed = self._feed
        while not feed.closed and self._n_answers == feed.n_answers:
            now_s = time.monotonic()
            frame_s = self._frame_due_s - now_s
            state_s = self._state_at_s + STATE_S - now_s
            if state_s <= 0:
                return
            if frame_s > 0:
                feed.changed.wait(min(frame_s, state_s))
            elif self._has_new_maps():
                return
            else:
                # Frames notify only those who are counted here.
                feed.n_waiting += 1
                feed.changed.wait(state_s)
                feed.n_waiting -= 1

    def _has_new_maps(self) -> bool:
        newest = {name: self._feed.patches[name].n_maps for name in self._names}
        return any(newest[name] != self._n_maps[name] for name in newest)

    def _collect(self, now_s: float, closed: bool) -> Iterator[Part]:
        feed = self._feed
        for number, answer in feed.answers:
            if number > self._n_answers:
                header = {"kind": "answer", **answer}
                yield header, {}
        self._n_answers = feed.n_answers

        # The last state is sent whenever it comes.
        if closed or now_s >= self._state_at_s + STATE_S - SLACK_S:
            self._state_at_s = now_s
            yield self._state(now_s, closed), {}
        if not closed and now_s < self._frame_due_s:
            return

        # The next is due one period after this one was due: delays do not add up.
        due_s = max(self._frame_due_s, now_s - SLACK_S)
        self._frame_due_s = due_s + self._period_s - SLACK_S

        for name in self._names:
            patch = feed.patches[name]
            if patch.skin is None:
                continue
            if self._is_new(f"skin {name}", patch.skin):
                yield _skin(name, patch, feed.poses.get(name))
            # Only the newest maps are sent: those between are skipped.
            if self._n_maps[name] != patch.n_maps and patch.maps:
                self._n_maps[name] = patch.n_maps
                yield from self._maps(name, patch, now_s)
        if self._patch is not None:
            yield from self._rows(feed.patches[self._patch], now_s)

    def _maps(self, name: str, patch: PatchFeed, now_s: float) -> Iterator[Part]:
        """New maps of a patch, with the contacts in them; none of an idle patch of an overview."""
        reconstruction = patch.maps.get(Reconstruction.schema)
        contacts = patch.contacts
        if contacts is not None and not contacts.id.size:
            contacts = None
        is_new = self._is_new(f"map {name}", reconstruction)
        is_new |= self._is_new(f"contacts {name}", contacts)

        arrays: Arrays = {}
        if self._patch is not None:
            arrays |= patch.maps
            if reconstruction is not None:
                arrays |= _measured(patch)
        elif not is_new:
            return
        elif reconstruction is not None:
            arrays[Reconstruction.schema] = reconstruction
        header = {"kind": "maps", "patch": name}
        header |= _contacts(patch, now_s)
        yield header, arrays

    def _rows(self, patch: PatchFeed, now_s: float) -> Iterator[Part]:
        """New rows of the history and of the events of a patch."""
        histories = {"rows": patch.history, "events": patch.events}
        for kind, history in histories.items():
            n_first, rows = history.since(self._n_rows[kind])
            if not len(rows):
                continue
            self._n_rows[kind] = n_first + len(rows)
            # As ages: float32 holds a minute to 4 us.
            rows[:, 0] -= now_s
            header = {"kind": kind, "columns": history.columns, "now_s": now_s}
            yield header, {"rows": rows.astype(np.float32)}

    def _state(self, now_s: float, closed: bool) -> Document:
        """The current state: a small record, which also shows that the monitor is alive."""
        feed = self._feed
        patches = {name: self._patch_state(name, now_s) for name in feed.patches}
        header: Document = {
            "kind": "state",
            "now_s": now_s,
            "closed": closed,
            "run": feed.run,
            "paused": feed.paused,
            "start": None,
            "notices": self._notices.all(now_s),
            "patches": patches,
        }
        if feed.start is not None:
            header["start"] = [feed.start.done, feed.start.of]

        if self._is_new("graph", feed.graph):
            header["graph"] = feed.graph
            header["hosts"] = host_lines(feed.graph or {})
        return header

    def _patch_state(self, name: str, now_s: float) -> Document:
        patch = self._feed.patches[name]
        ages_s = {key: now_s - came_s for key, came_s in patch.came_s.items()}
        state: Document = {
            "age_s": ages_s,
            "stale_s": patch.stale_s,
            "lost": patch.lost,
            "ended": patch.ended,
            "trusted": patch.trusted(now_s),
            "reason": None,
            "idle": patch.idle,
        }
        if self._feed.closed and patch.summary:
            # At the end the summary has counted all frames, too.
            state["lost"] = patch.summary["frames"]["lost"]
        if not state["trusted"]:
            state["reason"] = _reason(patch.reason)

        if patch.label is not None:
            label = {key: getattr(patch.label, key) for key in LABEL}
            label["silent_s"] = now_s - patch.label_came_s
            state["label"] = label
        if self._is_new(f"summary {name}", patch.summary):
            state["summary"] = patch.summary
        return state

    def _is_new(self, key: str, value: Any) -> bool:
        """True if this object has not been sent yet."""
        is_new = self._sent.get(key) is not value
        self._sent[key] = value
        return is_new


def _measured(patch: PatchFeed) -> Arrays:
    """Measurements of the frame shown in 1/127 of its largest, int8: for the eye; {}: not known."""
    # A frame that was skipped or lost is not among them.
    by_stamp = {each.stamp_ns: each for each in patch.measurements}
    if patch.stamp_ns not in by_stamp:
        return {}
    message = by_stamp[patch.stamp_ns]
    y = np.asarray(message.y)[0]
    # Measurements of 0 are divided, too.
    largest = float(np.abs(y).max(initial=0))
    scale = 127 / max(largest, TINY)
    levels = np.round(y * scale)
    return {"measurements": levels.astype(np.int8)}


def _reason(word: str) -> dict[str, str] | None:
    """A reason and its text; None where none is stated."""
    if not word:
        return None
    return {
        "word": word,
        "phrase": phrase_of(word),
        "sentence": sentence_of(word),
    }


def _contacts(patch: PatchFeed, now_s: float) -> Document:
    """Contacts of the frame shown: number and total of all, fields of the strongest."""
    contacts = patch.contacts
    if contacts is None:
        return {}
    age_ns = abs(contacts.stamp_ns - patch.stamp_ns)
    if age_ns > 1e9 * patch.stale_s:
        return {}

    # In the order of their numbers, so that a list of them does not jump.
    by_force = np.argsort(-contacts.total, kind="stable")
    strongest = by_force[:MOST]
    by_number = np.argsort(contacts.id[strongest])
    rows = strongest[by_number]
    document = {
        "n": contacts.id.size,
        "sum": float(contacts.total.sum()),
        "trusted": patch.trusted(now_s),
    }
    for name in CONTACT_FIELDS:
        column = getattr(contacts, name)
        if column is not None:
            document[name] = column[rows].tolist()
    return {"contacts": document}


def _skin(name: str, patch: PatchFeed, pose: Sequence[float] | None) -> Part:
    skin = patch.skin
    assert skin is not None
    header = {"kind": "skin", "patch": name, "pose": pose}
    for field in SKIN_FIELDS:
        header[field] = getattr(skin, field)
    header["sum_unit"] = sum_unit(skin.unit)

    arrays: Arrays = {}
    if skin.mask is not None:
        arrays["mask"] = skin.mask.view(np.uint8)
    if skin.points is not None:
        arrays["points"] = skin.points
    if skin.point_rows is not None:
        arrays["point_rows"] = skin.point_rows
    return header, arrays
