"""Contacts found by the default and in the full reading, beside the true ones, with their ids."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import ndimage

from sparseskin.messages import SkinState
from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.compressor.phi.rotation import ROTATING
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.contact_tracks import ContactTracker
from sparseskin.nodes.reconstructor.contacts import NEIGHBOURS
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.evaluate import Estimator, Method
from sparseskin.studies.frames import (
    Frames,
    PressFrames,
    SceneFrames,
    Take,
    UntouchedFrames,
    opened,
)
from sparseskin.studies.harness import Candidate, Measurement, method_rows
from sparseskin.studies.points import compute

from .experiments import DEFAULT, RATIOS, RAW

LEAST_N = 0.5
"""Least total of a true contact that counts, newtons. Chosen: six times the high threshold of one
taxel."""
FRAMES, QUICK_FRAMES = 600, 60
UNTOUCHED, QUICK_UNTOUCHED = 1000, 50
FRAME_NS = 1_000_000


def sources(quick: bool) -> list[Frames]:
    """Scenes, presses of 40 x 40 taxels, and an untouched skin."""
    n = QUICK_FRAMES if quick else FRAMES
    scenes = [SceneFrames(name, stop=n - 20) for name in ("drag_wrench_40", "path_40")]
    presses = [
        PressFrames(body, (40, 40), n // 4, course, 0.25)
        for body in ("wrench", "peg")
        for course in ("moving", "sudden")
    ]
    return [*scenes, *presses, UntouchedFrames(40, QUICK_UNTOUCHED if quick else UNTOUCHED)]


def rows(out: Path, executor: str, quick: bool, seeds: Sequence[int]) -> pd.DataFrame:
    """A row a source, ratio and seed: figures of `ContactScores`."""
    points: list[dict[str, Any]] = [
        {"frames": {"kind": type(one).__name__, **asdict(one)}, "ratio": ratio, "seed": seed}  # type: ignore[call-overload]
        for one in sources(quick)
        for ratio in (1, *RATIOS)
        for seed in seeds
    ]
    found = compute(followed, points, out, executor, "contacts")
    keys = [{**p["frames"], "ratio": p["ratio"], "seed": p["seed"]} for p in points]
    return method_rows(keys, found)


def followed(point: Mapping[str, Any]) -> dict[str, Any]:
    """Follow the contacts of a point's frames in the reconstruction; at ratio 1 in the reading."""
    take, ratio = opened(point), point["ratio"]
    name = RAW if ratio == 1 else DEFAULT
    made = Candidate(of="reading") if ratio == 1 else Candidate(PRESETS["skin"])
    estimator = made.make(Measurement(ratio, ROTATING), take, point["seed"])
    scores = ContactScores(take)
    for part in take.parts():
        if isinstance(estimator, Method):
            estimator.reset()
        scores.follow(estimator, list(part)[take.unscored :])
    return {"methods": {name: scores.figures()}}


class ContactScores:
    """Counts and errors of contacts that are followed, against the true ones."""

    def __init__(self, take: Take) -> None:
        self._take = take
        self.n_frames = self.n_true = self.n_found = self.n_ghosts = self.n_changes = 0
        self.off: list[float] = []
        self.relative: list[float] = []

    def _tracker(self, shape: tuple[int, int]) -> ContactTracker:
        take = self._take
        stated: dict[str, Any] = {"stamp_ns": 0, "patch": "skin", "unit": "N", "pitch_m": None}
        stated |= {"n_rows": shape[0], "n_cols": shape[1], "f_max": take.f_max, "source": ""}
        stated |= {"sigma_mid": take.sigma_end, "sigma_end": take.sigma_end}
        stated |= {"seed": 0, "rate_hz": 0.0, "has_truth": False, "mask": take.mask}
        return ContactTracker(SkinState(**stated))

    def follow(self, estimator: Estimator, frames: Sequence[tuple[Floats, Floats]]) -> None:
        """Follow the contacts of one part, in the estimate and in the truth."""
        tracker, true_ids = self._tracker(self._take.mask.shape), TrueIds(self._take.f_max)
        last: dict[int, int] = {}
        for k, (truth, taxels) in enumerate(frames):
            solved = estimator.reconstruct(taxels)
            stamp_ns = (k + 1) * FRAME_NS
            contacts = tracker.update(solved.forces, solved.error, stamp_ns)
            true = true_ids.update(truth)
            regions = tracker.regions.reshape(truth.shape)
            self._compare(truth, true, contacts.fields if contacts else None, regions, last)

    def _compare(
        self,
        truth: Floats,
        true: dict[int, Mask],
        found: dict[str, Any] | None,
        regions: np.ndarray[Any, Any],
        last: dict[int, int],
    ) -> None:
        self.n_frames += 1
        near = ndimage.binary_dilation(truth > 0, NEIGHBOURS)
        numbers = [] if found is None else found["id"].tolist()
        self.n_ghosts += sum(not near[regions == k + 1].any() for k in range(len(numbers)))
        for true_id, region in true.items():
            forces = np.where(region, truth, np.float32(0)).astype(np.float64)
            if (total := float(forces.sum())) < LEAST_N:
                continue
            self.n_true += 1
            counts = np.bincount(regions[region], minlength=len(numbers) + 1)[1:]
            if found is None or not counts.any():
                continue
            k = int(counts.argmax())
            self.n_found += 1
            self.n_changes += last.get(true_id, numbers[k]) != numbers[k]
            last[true_id] = numbers[k]
            centre = np.array([(axis * forces).sum() for axis in np.indices(truth.shape)]) / total
            self.off.append(float(np.linalg.norm(found["centre"][k] - centre)))
            self.relative.append(abs(float(found["total"][k]) - total) / total)

    def figures(self) -> dict[str, Any]:
        """Counts; ghosts a 1000 frames; medians of the errors, taxels and %; changes of ids."""
        missed = 1 - self.n_found / self.n_true if self.n_true else None
        return {
            "refused": "",
            "n_true": self.n_true,
            "missed": None if missed is None else 100 * missed,
            "ghosts": 1000 * self.n_ghosts / max(1, self.n_frames),
            "off": float(np.median(self.off)) if self.off else None,
            "force": 100 * float(np.median(self.relative)) if self.relative else None,
            "changes": 1000 * self.n_changes / self.n_true if self.n_true else None,
        }


class TrueIds:
    """Ids of the true contacts: each is the one of the frame before that it overlaps most with."""

    def __init__(self, f_max: float) -> None:
        self._least = CONTACT_FRACTION * f_max
        self._before: dict[int, Mask] = {}
        self._n = 0

    def update(self, truth: Floats) -> dict[int, Mask]:
        """Taxels of each true contact of a frame, by its id."""
        labels, n = ndimage.label(truth > self._least, NEIGHBOURS)
        found: dict[int, Mask] = {}
        for k in range(1, n + 1):
            region = labels == k
            shared = {i: int((region & one).sum()) for i, one in self._before.items()}
            best = max(shared, key=lambda i: shared[i], default=0)
            if not shared.get(best) or best in found:
                self._n += 1
                best = self._n
            found[best] = region
        self._before = found
        return found
