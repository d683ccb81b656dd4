"""Experiments of study `speed-accuracy`: not all combinations, but each part swept by itself.

- Time of a frame: every pace of the default, every other solver, every other library, at M = N/3.
- Bytes: every solver, with its own settings and with those of each preset, and M swept; every
  solver on Phi "full": all taxels denoised.
- Every basis and every Phi, with the paper's solver and M swept: on fewer frames, as a dense Phi
  is slow.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path

import numpy as np
import pandas as pd

from sparseskin.messages import Measurements, Taxels
from sparseskin.messages.wire import size_bytes
from sparseskin.nodes.compressor.phi.base import KINDS, phi_class, phi_fact
from sparseskin.nodes.compressor.phi.rotation import ROTATING, m_of
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.sensor.scenes.scenes import SCENES
from sparseskin.studies.baselines.libraries import PEERS
from sparseskin.studies.baselines.wavelets import BASES
from sparseskin.studies.evaluate import SUM_SOLVERS, VARIATION
from sparseskin.studies.frames import SceneFrames, scene_of
from sparseskin.studies.harness import (
    LARGER,
    PAPER_ROWS,
    Candidate,
    Experiment,
    Measurement,
)

QUICK_SCENES = ("drag_wrench_40", "lift_box_64")
RATIOS = (2, 3, 4, 8, 16)
QUICK_RATIOS = (3, 8)
PARTS_RATIOS = (3, 4, 8)
CENTRE_RATIO = 3
#: Every Phi but those that no solver of sums inverts.
SUM_KINDS = tuple(
    kind
    for kind in KINDS
    if not phi_fact(phi_class(kind), "choice") and kind != "row_local"
)
PAPER_LABEL = "fista, preset paper"
PRESET_SKIN = "skin, preset skin"
ROTATED = "skin, rotating rows"
FORMULA = "skin, formula"
INTERPOLATED = "random taxels, interpolated"
#: Best lambda of the paper's solver: a second reference.
TUNED_LAMBDA_N = 0.0125
#: Dead zones of the full reading, newtons.
DEAD_ZONES_N = (0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.07, 0.1)
#: Frames are 1 ms apart in all scenes, whatever their own step.
PERIOD_S = 1e-3
#: Figures of a row, and how they are pooled over scenes.
FIGURES = {
    "iterations": "mean",
    "mean_db": "mean",
    "min_db": "min",
    "touched_mn": "mean",
    "median_ms": "mean",
    "p99_ms": "mean",
    "cpu_share": "min",
}


def raced() -> dict[str, Candidate]:
    """What is shown by the time of a frame, by label; paces of the default are "LABEL: k".

    Every solver as it is installed: in compiled loops where it has them and numba is installed,
    and then the default in numpy, too. Every library of `PEERS` that is installed, on the problem
    of preset paper and with as many iterations per frame.
    """
    skin = PRESETS["skin"]
    paper = {"rows": PAPER_ROWS}
    rotating = {"rows": ROTATING}
    paces = {
        f"{ROTATED}: {pace}": Candidate({**skin, "iterations": pace}, changes=rotating)
        for pace in SkinSolver.paces
    }
    methods = {"skin, fixed rows": Candidate(skin)}
    if find_spec("numba"):
        methods["skin, numpy"] = Candidate({**skin, "fast": "off"}, changes=rotating)
    methods[PAPER_LABEL] = Candidate(PRESETS["paper"], changes=paper)
    methods["tv"] = Candidate({"solver": VARIATION, "basis": "haar"})
    subsample = {"phi": "subsample"}
    methods[INTERPOLATED] = Candidate({"solver": "interpolation"}, changes=subsample)
    methods |= LARGER
    for name, peer in PEERS.items():
        if not find_spec(peer.module):
            continue
        settings = {key: PRESETS["paper"][key] for key in ("iterations", "lambda_n")}
        settings["name"] = name
        methods[name] = Candidate(settings, of="library", changes=paper)

    # A pace follows another method, not a pace that has left its memory in the caches.
    turns = zip_longest(paces.items(), methods.items())
    return dict(candidate for turn in turns for candidate in turn if candidate)


def variants() -> dict[str, Candidate]:
    """Solvers that M is swept of, by the label they are shown with.

    Each preset, `skin` with rotating rows and without learned weights, the tuned FISTA, each
    solver that has no preset with its own defaults, and fewer, larger taxels.
    """
    paper = {"rows": PAPER_ROWS}
    solvers_by_label = {
        PAPER_LABEL: Candidate(PRESETS["paper"], changes=paper),
        PRESET_SKIN: Candidate(PRESETS["skin"]),
        ROTATED: Candidate(PRESETS["skin"], changes={"rows": ROTATING}),
        "fista, tuned": Candidate(
            {**PRESETS["paper"], "lambda_n": TUNED_LAMBDA_N}, changes=paper
        ),
        FORMULA: Candidate({**PRESETS["skin"], "gates": "formula"}),
    }
    solvers_by_label |= LARGER
    covered = {of.settings.get("solver", "") for of in solvers_by_label.values()}
    for label, name in SUM_SOLVERS.items():
        if name not in covered:
            solvers_by_label[label] = Candidate({"solver": name, "basis": "haar"})
    return solvers_by_label


def frames_of(quick: bool, short: bool) -> list[SceneFrames]:
    """Two parts of each scene: from 20 frames before its first contact, and half way on."""
    scenes = QUICK_SCENES if quick else tuple(SCENES)
    n_after, later = (40, 40) if short else (180, 200)
    frames = []
    for scene in scenes:
        every = max(1, round(PERIOD_S / (scene_of(scene).dt_ns * 1e-9)))
        frames.append(SceneFrames(scene, -20 * every, n_after * every, every, later))
    return frames


def times(quick: bool, seed: int) -> Experiment:
    """Time of a frame: all of `raced` in turn on each frame, so that other work on the host slows
    all of them alike.
    """
    frames = frames_of(quick, short=quick)
    measurements = [Measurement(CENTRE_RATIO)]
    return Experiment(
        "time of a frame", frames, measurements, raced(), tuple(FIGURES), (seed,)
    )


def solvers(quick: bool, seed: int) -> Iterator[Experiment]:
    """Every solver by M, and on all taxels."""
    by_label = variants()
    # Where all taxels are sent, neither rows rotate nor are there larger taxels.
    fixed = {
        label: candidate
        for label, candidate in by_label.items()
        if candidate.changes.get("rows") != ROTATING and label not in LARGER
    }
    frames = frames_of(quick, short=quick)
    swept = [*map(Measurement, QUICK_RATIOS if quick else RATIOS)]
    yield _timed("solvers", frames, swept, by_label, seed)
    yield _timed("solvers", frames, [Measurement(1, phi="full")], fixed, seed)


def _timed(
    label: str,
    frames: Sequence[SceneFrames],
    measurements: Sequence[Measurement],
    candidates: dict[str, Candidate],
    seed: int,
) -> Experiment:
    return Experiment(
        label,
        frames,
        measurements,
        candidates,
        tuple(FIGURES),
        (seed,),
        timed=True,
    )


def parts(quick: bool, seed: int) -> Iterator[Experiment]:
    """Every basis, and every Phi, with the paper's solver; the candidate is named by the basis."""
    # A dense Phi is slow.
    frames = frames_of(quick, short=True)
    ratios = QUICK_RATIOS if quick else PARTS_RATIOS
    changes = {"rows": PAPER_ROWS}
    bases = {
        label: Candidate({**PRESETS["paper"], "basis": name}, changes=changes)
        for label, name in BASES.items()
    }
    other_kinds = [kind for kind in SUM_KINDS if kind not in ("sbhe", "full")]
    kinds = [Measurement(ratio, phi=kind) for kind in other_kinds for ratio in ratios]
    haar = {"haar": bases["haar"]}
    yield _timed("bases and Phi", frames, [*map(Measurement, ratios)], bases, seed)
    measurements = [*kinds, Measurement(1, phi="full")]
    yield _timed("bases and Phi", frames, measurements, haar, seed)


def readings(quick: bool, seed: int) -> Experiment:
    """The noisy taxels themselves, with dead zones of several widths, which name the candidates."""
    frames = frames_of(quick, short=quick)
    zones = {
        f"{width:g}": Candidate({"dead_zone_n": width}, of="reading")
        for width in DEAD_ZONES_N
    }
    scores = ("mean_db", "min_db", "touched_mn")
    return Experiment("full readings", frames, [Measurement(1)], zones, scores, (seed,))


def pool_of(scene: str) -> str:
    """The panel that a scene is pooled into."""
    return f"N = {math.prod(scene_of(scene).shape)}"


@cache
def n_bytes(n: int, ratio: float, rows: str, phi: str) -> int:
    """Bytes of the message of a frame: of measurements, or of taxels with phi ""."""
    if not phi:
        return size_bytes(
            Taxels(
                stamp_ns=0,
                patch="skin",
                forces=np.zeros((1, n), np.float32),
            )
        )
    y = np.zeros(n if phi == "full" else m_of(n, ratio, rows), np.float32)
    return size_bytes(
        Measurements(
            stamp_ns=0,
            patch="skin",
            y=y,
            phi="0" * 16,
        )
    )


def pooled(rows: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Rows of scenes of one size as one row: panel and `keys`, and `FIGURES` as stated there."""
    of_scenes = rows[rows["refused"] == ""].assign(panel=rows["scene"].map(pool_of))
    figures = {name: how for name, how in FIGURES.items() if name in rows}
    of_scenes = of_scenes.astype(dict.fromkeys(figures, float))
    means = of_scenes.groupby(["panel", *keys], sort=False).agg(figures).reset_index()
    return means.sort_values("panel", kind="stable")


def gathered(
    experiments: Iterable[Experiment], out: Path, executor: str
) -> pd.DataFrame:
    """Rows of some experiments, with n_bytes, label, and pace: stated iterations, NaN if none."""
    parts = [experiment.run(out, executor) for experiment in experiments]
    rows = pd.concat(parts, ignore_index=True)
    split = rows["method"].str.split(": ", expand=True).reindex(columns=[0, 1])
    shapes = [math.prod(scene_of(scene).shape) for scene in rows["scene"]]
    rotates = [ROTATING if label == ROTATED else "" for label in split[0]]
    sizes = map(n_bytes, shapes, rows["ratio"], rotates, rows["phi"])
    return rows.assign(
        label=split[0],
        pace=pd.to_numeric(split[1]),
        n_bytes=list(sizes),
    )
