"""Contacts found by the default and in the full reading, beside the true ones, with their ids."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import ndimage

from sparseskin.nodes.compressor.phi.rotation import ROTATING
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.contact_tracks import EARLY, ContactTracker, joined
from sparseskin.nodes.reconstructor.contacts import NEIGHBOURS, Limits
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.evaluate import BAND, VALUE_BYTES, Estimator, Method
from sparseskin.studies.frames import (
    Frames,
    MeetingFrames,
    PressFrames,
    SceneFrames,
    Take,
    UntouchedFrames,
    opened,
    stated,
)
from sparseskin.studies.harness import Candidate, Measurement, method_rows
from sparseskin.studies.points import compute

from .experiments import DEFAULT, RATIOS, RAW

CONTACT_RATIOS = (*RATIOS, 16)
LEAST = 0.2
"""Least total of a true contact whose begin counts, in ranges of a taxel: 0.5 N. Chosen."""
FORCES = (0.2, 1.0, 5.0)
"""Bounds of the classes of total force, in ranges of a taxel. Chosen."""
CLASSES = ("below 0.2", "0.2 to 1", "1 to 5", "above 5")
FRAMES = 400
QUICK_FRAMES = 60
UNTOUCHED = 1000
QUICK_UNTOUCHED = 50
FRAME_NS = 1_000_000
MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value of normal numbers, in standard deviations. Derived."""
TRUE = Limits(low=1.0, high=0.5)
"""Limits of true contacts: all taxels above 0.4 % of the range."""


def sources(quick: bool) -> list[Frames]:
    """Scenes; presses of 40 x 40 taxels, strong and weak ones; two that meet; an untouched skin."""
    n = QUICK_FRAMES if quick else FRAMES
    scenes = [SceneFrames(name, -60, n) for name in ("drag_wrench_40", "path_40")]
    presses = [
        PressFrames(body, (40, 40), n, course, 0.25, part, strength=strength)
        for body, course, part, strength in (
            ("wrench", "moving", 0.1, 1.0),
            ("fingertips", "ramped", 0.1, 0.1),
            ("peg", "ramped", 0.03, 0.03),
            ("peg", "sudden", 0.1, 1.0),
        )
    ]
    n_untouched = QUICK_UNTOUCHED if quick else UNTOUCHED
    return [*scenes, *presses, MeetingFrames(40, n), UntouchedFrames(40, n_untouched)]


def rows(
    out: Path, executor: str, frames: Sequence[Frames], seeds: Sequence[int]
) -> pd.DataFrame:
    """A row a source, ratio and seed: figures of `ContactScores`."""
    # Ratio 1: the reading of all taxels.
    ratios = (1, *CONTACT_RATIOS)
    points = []
    for source, ratio, seed in product(map(stated, frames), ratios, seeds):
        points.append({"frames": source, "ratio": ratio, "seed": seed})
    results = compute(followed, points, out, executor, "contacts")
    keys = []
    for point in points:
        key = {"ratio": point["ratio"], "seed": point["seed"]}
        keys.append(point["frames"] | key)
    return method_rows(keys, results)


def followed(point: Mapping[str, Any]) -> dict[str, Any]:
    """Follow the contacts of a point's frames in the reconstruction; at ratio 1 in the reading."""
    take = opened(point)
    ratio = point["ratio"]
    name = DEFAULT
    candidate = Candidate(PRESETS["skin"])
    if ratio == 1:
        name = RAW
        candidate = Candidate(of="reading")
    estimator = candidate.make(Measurement(ratio, ROTATING), take, point["seed"])
    scores = ContactScores(take)
    for part in take.parts():
        scores.follow(estimator, list(part))
    return {"methods": {name: scores.figures()}}


class ContactScores:
    """Counts and errors of contacts that are followed, against the true ones."""

    def __init__(self, take: Take) -> None:
        self._take = take
        self.n_frames = 0
        self.n_ghosts = 0
        self.n_followed = 0
        self.n_lost = 0
        self.n_swapped = 0
        self.n_never = 0
        # By class of the total force.
        self.n_true = np.zeros(len(CLASSES), dtype=np.intp)
        self.n_missed = np.zeros(len(CLASSES), dtype=np.intp)
        self.delays: list[int] = []
        self.off: list[float] = []
        self.relative: list[float] = []
        # Errors in deviations: of totals, and of centres along both axes.
        self.in_sd: tuple[list[float], list[float]] = [], []
        # The same, beside the true forces on the taxels of the contact that was found.
        self.in_own_sd: tuple[list[float], list[float]] = [], []
        self.n_bytes = 0.0

    def follow(
        self, estimator: Estimator, frames: Sequence[tuple[Floats, Floats]]
    ) -> None:
        """Follow the contacts of one part, in the estimate and in the truth.

        The solver knows the noise that the skin states, as in a graph; frames in which no contact
        begins are not scored.
        """
        shape = self._take.mask.shape
        sigma = self._take.sigma_end
        state = self._take.state(sigma, sigma)
        tracker = ContactTracker(state)
        true = ContactTracker(self._take.state(0.0, 0.0))
        true.limits = TRUE
        if isinstance(estimator, Method):
            estimator.reset()
            estimator.solver.noise_sd = state.least_sd
            tracker.settle(len(estimator.phis))
        # Until all rows have been read a few times at the largest ratio.
        n_early = EARLY * max(CONTACT_RATIOS)
        part = _Part()
        for k, (truth, taxels) in enumerate(frames):
            solved = estimator.reconstruct(taxels)
            self.n_bytes = solved.n_bytes or VALUE_BYTES * self._take.n
            stamp_ns = (k + 1) * FRAME_NS
            tracked = tracker.update(
                solved.forces, solved.error, stamp_ns, common=solved.common_error
            )
            contacts = joined([tracked])
            true_contacts = joined([true.update(truth, None, stamp_ns)])
            if k < n_early:
                part.seen |= set(true_contacts["id"].tolist())
                continue
            self.n_frames += 1
            regions = tracker.regions.reshape(shape)
            of_truth = true.regions.reshape(shape)

            # A contact of which no taxel is near a touched one is a ghost.
            near = ndimage.binary_dilation(truth > 0, NEIGHBOURS)
            touching = np.unique(regions[near])
            self.n_ghosts += contacts["id"].size - int(np.count_nonzero(touching))
            self._compare(truth, true_contacts, of_truth, contacts, regions, part, k)

    def _compare(
        self,
        truth: Floats,
        true_contacts: dict[str, Any],
        of_truth: np.ndarray[Any, Any],
        contacts: dict[str, Any],
        regions: np.ndarray[Any, Any],
        part: _Part,
        k: int,
    ) -> None:
        """Compare the contacts of a frame with the true ones."""
        at: dict[int, int] = {}
        ids = true_contacts["id"].tolist()
        for row, contact_id in enumerate(ids):
            region = of_truth == row + 1
            total = float(true_contacts["total"][row]) / self._take.f_max
            if contact_id not in part.seen:
                part.seen.add(contact_id)
                part.begins[contact_id] = k
            largest = part.largest.get(contact_id, 0.0)
            part.largest[contact_id] = max(total, largest)
            # Taxels that it shares with each contact; number 0 is none.
            n_numbers = contacts["id"].size + 1
            counts = np.bincount(regions[region], minlength=n_numbers)[1:]
            hit = counts.any()
            force = int(np.digitize(total, FORCES))
            self.n_true[force] += 1
            self.n_missed[force] += not hit
            if hit:
                at[contact_id] = int(counts.argmax())
                if total >= LEAST:
                    taxels = regions == at[contact_id] + 1
                    self._found(truth, region, taxels, contacts, at[contact_id])
                if contact_id in part.begins:
                    self.delays.append(k - part.begins.pop(contact_id))

        # Those that have ended before they were found.
        ended = [contact_id for contact_id in part.begins if contact_id not in ids]
        for contact_id in ended:
            self.n_never += part.largest[contact_id] >= LEAST
            del part.begins[contact_id]
        # Where two true contacts are one for the tracker, an id says nothing.
        numbers = contacts["id"].tolist()
        shared = Counter(at.values())
        for contact_id, row in at.items():
            if shared[row] == 1:
                self._follow_id(contact_id, numbers[row], part, ids)

    def _found(
        self,
        truth: Floats,
        region: Mask,
        taxels: Mask,
        contacts: dict[str, Any],
        row: int,
    ) -> None:
        """Count the errors of a contact in a row, of some taxels; the true one is `region`."""
        errors = _errors(truth, region, contacts, row)
        self.off.append(math.hypot(*errors[1:]))
        true_total = float(contacts["total"][row]) - errors[0]
        self.relative.append(abs(errors[0] / true_total))
        _count_in_sd(self.in_sd, errors, contacts, row)
        if truth[taxels].any():
            own_errors = _errors(truth, taxels, contacts, row)
            _count_in_sd(self.in_own_sd, own_errors, contacts, row)

    def _follow_id(
        self, contact_id: int, number: int, part: _Part, ids: Sequence[int]
    ) -> None:
        """Compare the id found at a true contact with the one before."""
        self.n_followed += 1
        owner = contact_id
        for true_id, followed in part.number_of_id.items():
            if followed == number:
                owner = true_id
                break
        if part.number_of_id.get(contact_id, number) != number:
            if owner != contact_id and owner not in ids:
                return  # that one met this one, and they are one
            self.n_swapped += owner != contact_id
            self.n_lost += owner == contact_id
        if owner == contact_id or contact_id in part.number_of_id:
            part.number_of_id[contact_id] = number

    def figures(self) -> dict[str, Any]:
        """Counts by force; delays in frames; ghosts in 1000 frames; medians of the errors in
        taxels, mm and %, and in stated deviations (1: as stated); ids lost and swapped in 1000
        frames of a contact; bytes a frame.
        """
        total_errors, centre_errors = self.in_sd
        n_begins = len(self.delays) + self.n_never
        n_true = int(self.n_true.sum())
        n_found = n_true - self.n_missed.sum()
        # Ids are counted where a true contact is there to be followed.
        n_followed = max(1, self.n_followed) if n_true else 0
        off = _median(self.off)
        pitch_mm = self._take.pitch_mm or None
        return {
            "refused": "",
            "n_true": self.n_true.tolist(),
            "n_missed": self.n_missed.tolist(),
            "found": _scaled(100, n_found, n_true),
            "delay": _median(self.delays),
            "delay_95": _percentile(self.delays, 95),
            "begun": _scaled(100, len(self.delays), n_begins),
            "ghosts": 1000 * self.n_ghosts / max(1, self.n_frames),
            "off": off,
            "off_mm": _product(off, pitch_mm),
            "force": _product(_median(self.relative), 100),
            "total_sds": _product(_median(np.abs(total_errors)), 1 / MEDIAN_OF_NORMAL),
            "centre_sds": _product(
                _median(np.abs(centre_errors)), 1 / MEDIAN_OF_NORMAL
            ),
            "total_held": _share_within(total_errors),
            "centre_held": _share_within(centre_errors),
            "own_total_held": _share_within(self.in_own_sd[0]),
            "own_centre_held": _share_within(self.in_own_sd[1]),
            "lost": _scaled(1000, self.n_lost, n_followed),
            "swapped": _scaled(1000, self.n_swapped, n_followed),
            "n_bytes": self.n_bytes,
        }


def _errors(
    truth: Floats, region: Mask, contacts: dict[str, Any], row: int
) -> tuple[float, float, float]:
    """Errors of a contact's total, newtons, and centre, taxels, by the true forces of a region."""
    forces = np.where(region, truth, np.float32(0)).astype(np.float64)
    total = float(forces.sum())
    down, across = (float((axis * forces).sum()) for axis in np.indices(truth.shape))
    found_down, found_across = contacts["centre"][row].tolist()
    return (
        float(contacts["total"][row]) - total,
        found_down - down / total,
        found_across - across / total,
    )


def _count_in_sd(
    in_sd: tuple[list[float], list[float]],
    errors: tuple[float, float, float],
    contacts: dict[str, Any],
    row: int,
) -> None:
    """Add the errors of a total, and of a centre, in their stated deviations."""
    sds = contacts["total_sd"][row], *contacts["centre_sd"][row]
    for k, (error, sd) in enumerate(zip(errors, sds, strict=True)):
        if sd > 0:  # 0: the noise is not known, or the contact is one taxel
            in_sd[min(k, 1)].append(float(error / sd))


def _scaled(scale: float, count: float, of: int) -> float | None:
    """A count as so many in `scale`; None where there is nothing to count."""
    return scale * count / of if of else None


def _product(value: float | None, factor: float | None) -> float | None:
    if value is None or factor is None:
        return None
    return value * factor


def _percentile(values: Sequence[float], percent: float) -> float | None:
    return float(np.percentile(values, percent)) if values else None


def _share_within(errors: Sequence[float]) -> float | None:
    """Part in % of errors, in stated deviations, within the band that holds 90 % of normal ones."""
    if not errors:
        return None
    return 100 * float(np.mean(np.abs(errors) < BAND))


def _median(values: Any) -> float | None:
    return float(np.median(values)) if len(values) else None


@dataclass
class _Part:
    """True contacts of a part by id: all; begin and largest total of those not found yet; ids."""

    seen: set[int] = field(default_factory=set)
    begins: dict[int, int] = field(default_factory=dict)
    largest: dict[int, float] = field(default_factory=dict)
    number_of_id: dict[int, int] = field(default_factory=dict)
