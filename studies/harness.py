"""Experiments as data: frames, measurements and estimators, each combination scored once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import Phi, phi_class, phi_fact
from sparseskin.nodes.compressor.phi.rotation import FIXED, PAPER, m_of
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.skin.tuning import SkinTuning
from sparseskin.nodes.sensor.noise import NoiseModel

from .baselines.larger import LargerTaxels
from .baselines.libraries import Bpdn, Library, TotalVariation
from .baselines.sampling import CODECS, Codec, Filtered, Hold, Lattice
from .evaluate import (
    CLOSE,
    POOR,
    RIGHT,
    VANISHED,
    WRONG,
    Alone,
    Estimator,
    Method,
    Reading,
    Scores,
    evaluate,
    make_method,
    values_that_fit,
)
from .frames import Frames, Take, opened, stated
from .points import StudyError, compute

PAPER_ROWS = PAPER
"""Rows of the measurement matrix with preset `paper`."""
TIMED_ON = "process:1"
"""Executor of what is timed: one process at a time, so that it has its core to itself."""


@dataclass(frozen=True)
class Measurement:
    """Measurement matrix: ratio N / M; rows "fixed", "rotating" or "paper"; kind; size of the
    Hadamard blocks (None: that of the kind); bits of a measurement (None: float32).
    """

    ratio: float = 3
    rows: str = FIXED
    phi: str = "sbhe"
    block: int | None = None
    bits: int | None = None

    @property
    def of_compressor(self) -> dict[str, Any]:
        """Settings of a compressor beside the ratio."""
        return {
            "rows": self.rows,
            "phi": self.phi,
            "block": self.block,
        }


@dataclass(frozen=True)
class Candidate:
    """An estimator by the names of its parts.

    `settings`: solver, basis and settings as in `PRESETS`; `lambda_n` is stated for the paper's
    range, and scaled with that of the skin; `tuning`: fields of `SkinTuning` that are not its own;
    of "reading": dead_zone_n; of "tv": weight, for the paper's range, and iterations; of "library":
    name in `PEERS`, lambda_n and iterations. `of`: "solver", "reading", "filtered", "lattice",
    "hold", "larger", "tv", "library", or one of `CODECS`. `changes`: fields of the
    measurement that differ. `alone`: True to forget all earlier frames before each one.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    of: str = "solver"
    changes: Mapping[str, Any] = field(default_factory=dict)
    alone: bool = False

    def make(self, measurement: Measurement, take: Take, seed: int) -> Estimator:
        """Make the estimator for the skin of a take; `seed`: of Phi. Raises SparseskinError if it
        cannot be.
        """
        at = replace(measurement, **self.changes)
        mask = take.mask
        if self.of in CODECS:
            return Codec(mask, take.f_max, self.of)
        match self.of:
            case "solver":
                return self._method(at, take, seed)
            case "reading":
                return Reading(**self.settings)
            case "filtered":
                return Filtered(NoiseModel.for_range(take.f_max))
            case "lattice":
                return Lattice(mask, int(at.ratio))
            case "hold":
                return Hold(mask, int(at.ratio))
            case "larger":
                m = max(1, m_of(take.n, at.ratio))
                return LargerTaxels(mask, m)
            case "tv":
                return self._variation(at, take, seed)
            case "library":
                return self._library(at, take, seed)
        raise StudyError(f"a candidate is of {self.of!r}, which is no estimator")

    def _method(self, at: Measurement, take: Take, seed: int) -> Estimator:
        """A solver of measurements."""
        settings = dict(self.settings)
        if "lambda_n" in settings:
            settings["lambda_n"] *= take.f_max / PAPER_F_MAX_N
        if "tuning" in settings:
            settings["tuning"] = SkinTuning(**settings["tuning"])
        if phi_fact(phi_class(at.phi), "choice"):
            # As many rows as fit, with the code of their choice, into the bytes of M; M is rounded
            # down, and a half keeps it from rounding errors.
            rows = values_that_fit(at.phi, take.mask, m_of(take.n, at.ratio))
            at = replace(at, ratio=take.n / (rows + 0.5))
        method = make_method(
            settings,
            take.mask.shape,
            at.ratio,
            seed,
            mask=take.mask,
            f_max_n=take.f_max,
            sigma_end=take.sigma_end,
            **at.of_compressor,
        )
        method.bits = at.bits
        return Alone(method) if self.alone else method

    def _variation(self, at: Measurement, take: Take, seed: int) -> Estimator:
        weight = self.settings["weight"] * take.f_max / PAPER_F_MAX_N
        phi = _first_phi(at, take, seed)
        return TotalVariation(phi, take.mask, weight, self.settings["iterations"])

    def _library(self, at: Measurement, take: Take, seed: int) -> Estimator:
        lambda_n = self.settings["lambda_n"] * take.f_max / PAPER_F_MAX_N
        basis = make_basis("haar", *take.mask.shape)
        phi = _first_phi(at, take, seed)
        problem = Bpdn(phi, basis, lambda_n, take.sigma_end)
        return Library(self.settings["name"], problem, self.settings["iterations"])


LARGER = {"larger taxels": Candidate(of="larger")}
"""Fewer, larger taxels, the simplest thing that a maker can do: a row of every comparison."""


def _first_phi(at: Measurement, take: Take, seed: int) -> Phi:
    """Measurement matrix of the first frame of a take."""
    n_rows, n_cols = take.mask.shape
    skin = Skin(n_rows, n_cols, take.f_max, mask=take.mask)
    settings = CompressorSettings(
        ratio=at.ratio,
        seed=seed,
        **at.of_compressor,
    )
    return settings.phis(skin)[0]


@dataclass(frozen=True)
class Experiment:
    """Every candidate, by name, on every source of frames at every measurement; `scores`: names of
    `SCORES`; `seeds`: of frames, noise and Phi. `timed`: True if each candidate is run by itself,
    in one process at a time, whatever the executor. `label` is shown by the progress bar.
    """

    label: str
    frames: Sequence[Frames]
    measurements: Sequence[Measurement]
    candidates: Mapping[str, Candidate]
    scores: Sequence[str]
    seeds: Sequence[int] = (0,)
    timed: bool = False

    def points(self) -> list[dict[str, Any]]:
        """Points as `scored` takes them."""
        candidates = {}
        for name, candidate in self.candidates.items():
            candidates[name] = asdict(candidate)
        groups = [candidates]
        if self.timed:
            # Alone: candidates of one point run in turn.
            groups = [{name: candidate} for name, candidate in candidates.items()]
        sources = map(stated, self.frames)
        measurements = map(asdict, self.measurements)
        points = []
        combinations = product(sources, measurements, groups, self.seeds)
        for frames, measurement, group, seed in combinations:
            point = {
                "frames": frames,
                "measurement": measurement,
                "candidates": group,
                "seed": seed,
                "scores": list(self.scores),
            }
            points.append(point)
        return points

    def run(self, out: Path, executor: str) -> pd.DataFrame:
        """Compute what is not known yet in the folder of the study; see `points.compute`. A row a
        point and candidate: fields of frames and measurement, seed, method (name of the candidate),
        its scores, and refused: why it could not be run, or "".
        """
        points = self.points()
        if self.timed:
            executor = TIMED_ON
        results = compute(scored, points, out, executor, self.label)
        keys = []
        for point in points:
            fields = point["frames"] | point["measurement"]
            keys.append(fields | {"seed": point["seed"]})
        rows = method_rows(keys, results)
        return rows.drop(columns="kind", errors="ignore")


def scored(point: dict[str, Any]) -> dict[str, Any]:
    """Run the candidates of a point of an `Experiment` side by side on the same frames; methods: by
    candidate its scores, and refused.
    """
    take = opened(point)
    measurement = Measurement(**point["measurement"])
    mask = None if take.mask.all() else take.mask
    scores = {}
    estimators = {}
    for name, fields in point["candidates"].items():
        scores[name] = Scores(take.f_max, mask, take.norm, take.total)
        candidate = Candidate(**fields)
        try:
            estimators[name] = candidate.make(measurement, take, point["seed"])
        except SparseskinError as error:
            scores[name].refused = str(error)

    # Between two parts frames are missing: what is carried from frame to frame is forgotten.
    for part in take.parts():
        for estimator in estimators.values():
            if isinstance(estimator, Method | Library):
                estimator.reset()
        evaluate(estimators, part, scores, take.unscored)

    methods = {}
    for name, score in scores.items():
        figures = dict.fromkeys(point["scores"])
        if not score.refused:
            for key in figures:
                figures[key] = SCORES[key](score)
        methods[name] = {"refused": score.refused, **figures}
    return {"methods": methods}


def method_rows(
    keys: Sequence[Mapping[str, Any]],
    found: Sequence[Mapping[str, Any]],
    name: str = "method",
) -> pd.DataFrame:
    """A row a point and method: keys of the point, the method in column `name`, its figures of
    `found`.
    """
    rows = []
    for key, of_point in zip(keys, found, strict=True):
        for method, figures in of_point["methods"].items():
            rows.append(
                {
                    **key,
                    name: method,
                    **figures,
                }
            )
    return pd.DataFrame(rows)


def unrefused(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of an experiment; raises StudyError with the reason if a candidate was refused."""
    for row in rows[rows["refused"] != ""].to_dict("records"):
        raise StudyError(f"{row['method']}, N/{row['ratio']:g}: {row['refused']}")
    return rows


def _mean(values: Sequence[float | bool], times: float = 1.0) -> float | None:
    if not len(values):
        return None
    return times * float(np.mean(values))


def _percentile(
    values: Sequence[float], percent: float, times: float = 1.0
) -> float | None:
    if not values:
        return None
    return times * float(np.percentile(values, percent))


def _firsts(scores: Scores) -> list[bool]:
    """Marks of the contact frames whose last one was not in contact."""
    marks = []
    for was_touched, is_touched in pairwise([False, *scores.contact]):
        marks.append(is_touched and not was_touched)
    return marks


def _first_db(scores: Scores) -> list[float]:
    """PSNR of the first frames of contacts, dB."""
    frames = zip(scores.psnr_db, _firsts(scores), strict=True)
    return [psnr_db for psnr_db, is_first in frames if is_first]


def _touched_mn(scores: Scores) -> float | None:
    if not scores.touched:
        return None
    squared, n_touched = zip(*scores.touched, strict=True)
    return 1e3 * float(np.sqrt(np.average(squared, weights=n_touched)))


def _flagged(scores: Scores, least: float, most: float) -> list[bool]:
    """Marks of the frames whose relative error is above `least` and below `most`."""
    return [flag for flag, relative in scores.flags if least < relative < most]


def _marked(scores: Scores) -> list[float]:
    """Relative errors of the contact frames that are marked."""
    # The relative error of a frame without contact is NaN.
    errors = [relative for is_flagged, relative in scores.flags if is_flagged]
    return [relative for relative in errors if not math.isnan(relative)]


def _of_contact(score: Callable[[Scores], Any]) -> Callable[[Scores], Any]:
    """That score, None where no frame is in contact."""

    def of_contact(scores: Scores) -> Any:
        if not scores.contact_db:
            return None
        return score(scores)

    return of_contact


SCORES: dict[str, Callable[[Scores], Any]] = {
    # PSNR of contact frames, dB: mean, least, mean of the first frames of contacts; of each frame.
    "mean_db": lambda s: _mean(s.contact_db),
    "min_db": _of_contact(lambda s: min(s.contact_db)),
    "first_db": lambda s: _mean(_first_db(s)),
    "psnr_db": lambda s: [round(db, 3) for db in s.psnr_db],
    "highest_db": lambda s: max(s.psnr_db),
    # Root mean square error of the touched taxels in contact frames, millinewtons.
    "touched_mn": _touched_mn,
    # Relative error of contact frames in %, and part of them that has vanished.
    "median": _of_contact(lambda s: 100 * float(np.median(s.relative))),
    "mean": _of_contact(lambda s: _mean(s.relative, 100)),
    "vanished": _of_contact(
        lambda s: _mean([error >= VANISHED for error in s.relative], 100)
    ),
    # Part of the untouched frames that are ghosts; of all, wrong and right frames that are marked.
    "ghosts": lambda s: _mean(s.ghosts, 100),
    "flagged": lambda s: _mean([flag for flag, _ in s.flags], 100),
    "flagged_wrong": lambda s: _mean(_flagged(s, WRONG, np.inf), 100),
    "flagged_right": lambda s: _mean(_flagged(s, -np.inf, RIGHT), 100),
    "n_wrong": lambda s: len(_flagged(s, WRONG, np.inf)),
    "n_right": lambda s: len(_flagged(s, -np.inf, RIGHT)),
    # Marked contact frames, and part of them that are poor.
    "n_flagged": lambda s: len(_marked(s)),
    "flagged_poor": lambda s: _mean([relative > POOR for relative in _marked(s)], 100),
    # Estimated over true RMS error of contact frames; part of them within a factor.
    "estimate_close": lambda s: _mean(
        [1 / CLOSE < ratio < CLOSE for ratio in s.estimates], 100
    ),
    # Touched taxels of these frames whose true force is within its band of 90 %, in %; the same
    # with the true RMS error of each frame.
    "held": lambda s: _mean(s.in_band, 100),
    "held_by_true": lambda s: _mean(s.in_true_band, 100),
    **{
        f"estimate_{name}": lambda s, percent=percent: _percentile(s.estimates, percent)  # type: ignore[misc]
        for name, percent in (("low", 5), ("median", 50), ("high", 95))
    },
    "n_contact": lambda s: len(s.contact_db),
    "n_untouched": lambda s: len(s.ghosts),
    "n_bytes": lambda s: _mean(s.n_bytes),
    # Solve time: of the processor and by the clock, ms; part in which the process had a core.
    "median_ms": lambda s: _percentile(s.cpu_s, 50, 1e3),
    "p99_ms": lambda s: _percentile(s.wall_s, 99, 1e3),
    "mean_ms": lambda s: _mean(s.wall_s, 1e3),
    "cpu_share": lambda s: sum(s.cpu_s) / sum(s.wall_s),
    "iterations": lambda s: _mean(s.n_steps),
}
"""Scores of one estimator over all frames, by name; None where there is no such frame."""
