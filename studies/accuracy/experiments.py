"""Experiments of study `accuracy`: the default beside what a user would try first, by frames."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from sparseskin.nodes.compressor.phi.rotation import ROTATING, ROWS
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.sensor.scenes import scenes
from sparseskin.studies.baselines.sampling import CODECS
from sparseskin.studies.frames import (
    Frames,
    PressFrames,
    RecordedFrames,
    SceneFrames,
    digest_of,
    files_in,
    part_of,
    scene_of,
)
from sparseskin.studies.harness import (
    LARGER,
    PAPER_ROWS,
    Candidate,
    Experiment,
    Measurement,
)
from sparseskin.studies.points import StudyError
from sparseskin.studies.presses import BODIES, COURSES, SKINS

RATIOS = (3, 4, 8)
DEFAULT = "skin, rotating"
SKIN = "skin"
PAPER = "paper"
ADAPTIVE = "skin, adaptive"
ALONE = "skin, each frame alone"
FEW_STEPS = "skin, 3 iterations"
FORMULA = "skin, formula"
ALIKE = ("lattice", "hold", *LARGER)
"""Of `SIMPLE` those that need no choice of taxels, on all frames."""
SIMPLE = (*ALIKE, "subsample", "acts")
"""Methods that need no measurement matrix: single taxels, or fewer, larger ones."""
ALL = "skin, all taxels"
FILTERED = "all taxels, filtered"
RAW = "all taxels, raw"
CANDIDATES = {
    DEFAULT: Candidate(PRESETS["skin"], changes={"rows": ROTATING}),
    SKIN: Candidate(PRESETS["skin"]),
    ADAPTIVE: Candidate(PRESETS["skin"], changes={"phi": "adaptive"}),
    ALONE: Candidate(PRESETS["skin"], alone=True),
    FEW_STEPS: Candidate(
        {**PRESETS["skin"], "iterations": 3}, changes={"rows": ROTATING}
    ),
    FORMULA: Candidate(
        {**PRESETS["skin"], "gates": "formula"}, changes={"rows": ROTATING}
    ),
    PAPER: Candidate(PRESETS["paper"], changes={"rows": PAPER_ROWS}),
    "lattice": Candidate(of="lattice"),
    "hold": Candidate(of="hold"),
    "subsample": Candidate({"solver": "interpolation"}, changes={"phi": "subsample"}),
    "acts": Candidate({"solver": "interpolation"}, changes={"phi": "acts"}),
    **LARGER,
}
READINGS = {
    ALL: Candidate(PRESETS["skin"]),
    FILTERED: Candidate(of="filtered"),
    RAW: Candidate(of="reading"),
}
"""Estimators that read all taxels."""

WEIGHTS_N = (0.002, 0.008, 0.032)
"""Weights of total variation and of Haar for the paper's range, newtons."""
FEW = "in the time of skin"
MANY = "converged"
"""Iterations of the methods beside `skin`."""
SINGLE = {
    SKIN: Candidate(PRESETS["skin"], alone=True),
    **{
        f"TV {label}, {weight:g}": Candidate(
            {"weight": weight, "iterations": n}, of="tv"
        )
        for label, n in ((FEW, 4), (MANY, 1500))
        for weight in WEIGHTS_N
    },
    **{
        f"Haar {label}, {weight:g}": Candidate(
            {
                "solver": "fista",
                "basis": "haar",
                "iterations": n,
                "lambda_n": weight,
            },
            alone=True,
        )
        for label, n in ((FEW, 30), (MANY, 1000))
        for weight in WEIGHTS_N
    },
}
"""Methods that reconstruct each frame by itself; total variation is that of SigPy."""
ALONE_FRAMES = 4

SCENES = tuple(scenes.SCENES)
SCENE_FRAMES = 4000
QUICK_SCENE_FRAMES = 150
RATED_SCENES = ("drag_wrench_40", "path_40", "drag_wrench_64")
RATES_HZ = (1000, 300, 100, 30)
SPAN_S = 3.0
QUICK_SPAN_S = 0.7
BEFORE_S = 0.02
"""Time from shortly before the first contact on, and untouched time before it."""
SIDES = (40, 64)
QUICK_BODIES = ("wrench", "peg")
SPEED = 0.25
TOUCHED = 0.1
PRESS_FRAMES = 160
QUICK_PRESS_FRAMES = 60
"""Of moving bodies: taxels a frame, part of the skin that is touched, frames; of constants
in a quick run."""
SIZES = (
    *((shape, None) for shape in SKINS if shape[0] < 40),
    ((20, 20), None),
    ((20, 20), 42),
)
"""Small skins: shape, and number of scattered taxels (None: one in each cell)."""
QUICK_SIZES = (((4, 4), None), ((10, 10), None))
ACTIVE = (0.1, 0.3, 0.6)
SIZE_FRAMES = 60
LONGEST_RECORDED = 300
QUICK_RECORDED = 60

PSNR = ("mean_db", "min_db", "first_db", "touched_mn", "n_contact")
ERRORS = ("median", "mean", "vanished", "n_bytes", "n_contact")
MARKS = (
    "flagged",
    "flagged_wrong",
    "n_wrong",
    "flagged_right",
    "n_right",
    "flagged_poor",
    "n_flagged",
)
ESTIMATES = (
    "estimate_low",
    "estimate_median",
    "estimate_high",
    "estimate_close",
    "held",
    "held_by_true",
)


class Runs:
    """Runs of the experiments, each of which returns its rows; `seeds`: of Phi, frames and noise.
    Of files in `recordings` that cannot be used there is a line on stderr; StudyError if none can.
    """

    def __init__(
        self,
        out: Path,
        executor: str,
        quick: bool,
        seeds: Sequence[int],
        recordings: Path | None,
    ) -> None:
        self._out = out
        self._executor = executor
        self._quick = quick
        self._seeds = seeds
        self._n_recorded = QUICK_RECORDED if quick else LONGEST_RECORDED
        self._files: list[Path] = []
        if recordings:
            self._files = readable(files_in(recordings), self._n_recorded)

    def _rows(
        self,
        label: str,
        frames: Sequence[Frames],
        names: Sequence[str],
        scores: Sequence[str],
        readings: Sequence[str] = (RAW,),
        ratios: Sequence[int] = RATIOS,
    ) -> pd.DataFrame:
        """Rows of `CANDIDATES` at some ratios, and of the readings of all taxels at ratio 1."""
        packed = {kind: Candidate(of=kind) for kind in CODECS}
        all_candidates = CANDIDATES | READINGS | packed
        # Readings have no ratio: they are run once.
        runs = (
            (label, names, ratios),
            (f"{label}, all taxels", readings, (1,)),
        )
        parts = []
        for title, names_of_run, ratios_of_run in runs:
            measurements = [Measurement(ratio) for ratio in ratios_of_run]
            candidates = {name: all_candidates[name] for name in names_of_run}
            rows = self._run(title, frames, measurements, candidates, scores)
            parts.append(rows)
        return pd.concat(parts)

    def _run(self, *parts: Any) -> pd.DataFrame:
        """Rows of an experiment of these parts."""
        make_experiment: Callable[..., Experiment] = partial(
            Experiment, seeds=self._seeds
        )
        return make_experiment(*parts).run(self._out, self._executor)

    def scenes(self) -> pd.DataFrame:
        """The six scenes of the paper, at their own frame rates."""
        stop = QUICK_SCENE_FRAMES if self._quick else SCENE_FRAMES
        frames = [SceneFrames(scene, stop=stop - 20) for scene in SCENES]
        names = (DEFAULT, SKIN, ADAPTIVE, PAPER)
        scores = (*PSNR, *MARKS, *ESTIMATES)
        return self._rows("scenes", frames, names, scores, (RAW, ALL))

    def rates(self) -> pd.DataFrame:
        """Scenes of which every k-th frame is read, so that bodies move further a frame."""
        names = (DEFAULT, SKIN, PAPER, ALONE, *ALIKE)
        frames = list(rated_frames(self._quick))
        rows = self._rows(
            "rates", frames, names, PSNR, (ALL, FILTERED, RAW), ratios=(3,)
        )
        step_ms = rows["scene"].map(lambda scene: 1e-6 * scene_of(scene).dt_ns)
        return rows.assign(spacing_ms=rows["every"] * step_ms)

    def moving(self) -> pd.DataFrame:
        """Bodies that move a quarter of a taxel a frame, ramps, and sudden contacts."""
        frames = [
            PressFrames(body, (side, side), PRESS_FRAMES, course, SPEED, TOUCHED)
            for side in SIDES
            for course in COURSES
            for body in (QUICK_BODIES if self._quick else BODIES)
        ]
        names = (DEFAULT, SKIN, FEW_STEPS, FORMULA, ADAPTIVE, PAPER, *ALIKE)
        return self._rows("presses", frames, names, (*PSNR, *MARKS, *ESTIMATES))

    def sizes(self) -> pd.DataFrame:
        """Sudden contacts on small skins."""
        frames = [
            PressFrames(body, shape, SIZE_FRAMES, "sudden", active=part, n_scattered=n)
            for shape, n in (QUICK_SIZES if self._quick else SIZES)
            for part in ACTIVE
            for body in BODIES
        ]
        names = (DEFAULT, SKIN, PAPER, *ALIKE)
        return self._rows("sizes", frames, names, ERRORS)

    def constants(
        self, candidates: Mapping[str, Candidate], label: str = "constants"
    ) -> pd.DataFrame:
        """Candidates at the largest ratio, fixed and rotating rows: on recordings, half as long as
        those of `recordings`; on bodies that move, and on a sudden contact.
        """
        ratio = max(RATIOS)
        side = SIDES[0]
        n_frames = QUICK_PRESS_FRAMES if self._quick else PRESS_FRAMES
        frames: list[Frames] = [*self.recorded_frames(self._n_recorded // 2)]
        frames += [
            PressFrames(body, (side, side), n_frames, course, SPEED, TOUCHED)
            for course, bodies in (
                ("moving", QUICK_BODIES),
                ("sudden", QUICK_BODIES[:1]),
            )
            for body in bodies
        ]
        measurements = [Measurement(ratio, rows) for rows in ROWS]
        scores = ("median", "flagged_wrong", "n_wrong", "mean_db")
        return self._run(label, frames, measurements, candidates, scores)

    def frames_alone(self) -> pd.DataFrame:
        """Single frames without a past, beside total variation and Haar, each weight by itself."""
        stop = ALONE_FRAMES * 100
        measurements = [*map(Measurement, RATIOS)]
        scenes = [
            SceneFrames(
                scene,
                first=0,
                stop=stop,
                every=100,
            )
            for scene in SCENES[:4]
        ]
        frames: list[Frames] = [*self.recorded_frames(ALONE_FRAMES), *scenes]
        return self._run(
            "frames alone", frames, measurements, SINGLE, ("median", "mean_ms")
        )

    def recorded_frames(self, n_most: int | None = None) -> list[RecordedFrames]:
        """The recordings as sources of frames, of at most `n_most` each."""
        # The first frames are not scored: until "hold" has read all taxels once.
        n = n_most or self._n_recorded
        unscored = max(RATIOS)
        return [
            RecordedFrames(str(path), digest_of(path), n, unscored)
            for path in self._files
        ]

    def recordings(self) -> pd.DataFrame:
        """Recordings of real skins; the recording itself is the truth."""
        scores = (*ERRORS, *MARKS, *ESTIMATES, "ghosts", "n_untouched")
        frames = self.recorded_frames()
        rows = self._rows("recordings", frames, tuple(CANDIDATES), scores, CODECS)
        # Two files may differ in their suffix alone.
        stems = [path.stem for path in self._files]
        labels = {}
        for path in self._files:
            is_alone = stems.count(path.stem) == 1
            labels[str(path)] = path.stem if is_alone else path.name
        return rows.assign(recording=rows["path"].map(labels))


def rated_frames(
    quick: bool, rates_hz: Sequence[int] = RATES_HZ
) -> Iterator[SceneFrames]:
    """Scenes at each frame rate, over the same time."""
    span_s = QUICK_SPAN_S if quick else SPAN_S
    for scene in RATED_SCENES:
        step_s = 1e-9 * scene_of(scene).dt_ns
        begin = -round(BEFORE_S / step_s)
        for rate_hz in rates_hz:
            every = max(1, round(1 / (rate_hz * step_s)))
            yield SceneFrames(scene, begin, begin + round(span_s / step_s), every)


def readable(files: Sequence[Path], n_most: int) -> list[Path]:
    """The recordings that can be used; of each other one a line on stderr. StudyError if there is
    none.
    """
    usable: list[Path] = []
    for path in files:
        try:
            part_of(str(path), n_most)
            usable.append(path)
        except SparseskinError as error:
            print(f"accuracy: skipped: {error}", file=sys.stderr)
    if not usable:
        raise StudyError(
            f"--recordings {files[0].parent}: none of {len(files)} files can be used"
        )
    return usable
