"""Study `bases`: sparsity of a skin's forces in several bases, and other ways of sampling."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.nodes.compressor.phi.acts import force_threshold
from sparseskin.nodes.compressor.phi.rotation import FIXED, PAPER
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import LEARNED, make_basis
from sparseskin.nodes.reconstructor.bases.haar import haar_matrix
from sparseskin.nodes.reconstructor.bases.learned import (
    KEPT_FRACTION,
    draw_windows,
    learn_atoms,
)
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.evaluate import Reading, evaluate, in_contact, make_method
from sparseskin.studies.points import Function, StudyError, compute
from sparseskin.studies.report import frame_of
from sparseskin.studies.scene_frames import first_contact, scene_frames, scene_of, spacing_ms

from .page import KEPT_PARTS, LAMBDAS_N, SAMPLINGS, write

#: Body that presses in each scene.
BODIES = {
    "lift_box_40": "box",
    "lift_wrench_40": "wrench",
    "drag_wrench_40": "wrench",
    "path_40": "peg",
    "lift_box_64": "box",
    "drag_wrench_64": "wrench",
}
#: One scene of a body is enough to learn from.
TRAINING = {"box": "lift_box_40", "wrench": "drag_wrench_40", "peg": "path_40"}
#: The same body on the other array (two scenes of one array begin with the same fall); of the
#: peg there is one scene, whose path the seed draws.
SAME_BODY = {
    "lift_box_40": "lift_box_64",
    "lift_wrench_40": "drag_wrench_64",
    "drag_wrench_40": "drag_wrench_64",
    "path_40": "path_40",
    "lift_box_64": "lift_box_40",
    "drag_wrench_64": "drag_wrench_40",
}
QUICK_SCENES = ("lift_box_40", "lift_wrench_40")
REGISTERED = ("haar", "db2", "db4", "sym4", "coif1", "dct", "identity")
TILED, LEARNED_BASES = "haar, tiles", ("learned", "learned, same body")
RATIOS = (3, 4)
SAMPLED_RATIOS, QUICK_SAMPLED_RATIOS = (3, 4, 8, 16), (4, 16)
N_FRAMES, QUICK_FRAMES = 300, 25
SAMPLED_FRAMES, QUICK_SAMPLED_FRAMES = 4000, 60
ITERATIONS = 30
TRAINING_FRAMES, TRAINING_TILE = 150, 8
#: Below this a coefficient is the rounding of float32 forces of 2.5 N, newtons.
ROUNDING_N = 1e-6
#: Untouched frames before the first contact, so that a solver has settled.
BEFORE = 20

Point = dict[str, Any]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the study and write its page and the learned bases; see `command.Study`.

    Bases are learned from scenes of the next seed.
    """
    scenes = QUICK_SCENES if quick else tuple(BODIES)
    training = [point for scene in scenes for point in training_of(scene, seed)]
    distinct = list({str(point): point for point in training}.values())
    learnt = compute(learned, distinct, out, executor, "learn")
    file_of = {
        str(point): _saved(out, f"learned_{k}", np.array(found["atoms"]))
        for k, (point, found) in enumerate(zip(distinct, learnt, strict=True))
    }
    registered = {name: name for name in REGISTERED}
    registered[TILED] = _saved(out, "haar_tiles", haar_matrix((TRAINING_TILE, TRAINING_TILE)))
    n_frames = QUICK_FRAMES if quick else N_FRAMES
    n_sampled = QUICK_SAMPLED_FRAMES if quick else SAMPLED_FRAMES
    counting: list[Point] = []
    for scene in scenes:
        files = [file_of[str(point)] for point in training_of(scene, seed)]
        bases = registered | dict(zip(LEARNED_BASES, files, strict=True))
        counting.append({"scene": scene, "bases": bases, "n_frames": n_frames, "seed": seed})
    solving = [{**point, "ratio": ratio} for point in counting for ratio in RATIOS]
    sampling = [
        {"scene": scene, "ratio": ratio, "n_frames": n_sampled, "seed": seed}
        for scene in scenes
        for ratio in (QUICK_SAMPLED_RATIOS if quick else SAMPLED_RATIOS)
    ]

    def rows(function: Function, points: list[Point], label: str, by: str) -> pd.DataFrame:
        """A row a name, with scene and ratio of its point."""
        found = compute(function, points, out, executor, label)
        keys: list[Point] = [
            {key: point[key] for key in ("scene", "ratio") if key in point} for point in points
        ]
        return frame_of(keys, found, by)

    write(
        out,
        counted=rows(coefficients, counting, "count", "basis"),
        reconstructed=rows(reconstructed, solving, "solve", "basis"),
        sampled=rows(sampled, sampling, "sample", "sampling"),
        spacing={
            scene: (spacing_ms(scene, spread_by(scene, seed, n_frames)), spacing_ms(scene))
            for scene in scenes
        },
    )


def training_of(scene: str, seed: int) -> list[Point]:
    """Points of the bases that are learned for a scene, in the order of their names."""
    others = [name for body, name in TRAINING.items() if body != BODIES[scene]]
    return [{"scenes": names, "seed": seed + 1} for names in (others, [SAME_BODY[scene]])]


def _saved(out: Path, name: str, atoms: Any) -> str:
    """Write atoms as `sparseskin learn-basis` does; the basis by its name in a launch file."""
    path = out / f"{name}.npz"
    try:
        np.savez(path, atoms=np.asarray(atoms, dtype=np.float64))
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror}") from error
    return f"{LEARNED}{path}"


def spread_frames(scene: str, seed: int, n_frames: int) -> Iterator[tuple[Floats, Floats]]:
    """Yield (truth, taxels) of about n_frames frames, evenly from the first contact to the end."""
    every = spread_by(scene, seed, n_frames)
    return scene_frames(scene, seed, first_contact(scene, seed), None, every)


def spread_by(scene: str, seed: int, n_frames: int) -> int:
    """Stride of about n_frames frames, evenly from a scene's first contact to its end."""
    return max(1, (scene_of(scene).n_steps - first_contact(scene, seed)) // n_frames)


def learned(point: Point) -> dict[str, Any]:
    """Learn a basis from the true forces of some scenes.

    `point`: scenes, seed.

    Returns
    -------
    dict
        atoms: 64 x 64, rounded to float32.
    """
    rng = np.random.default_rng(point["seed"])
    parts = []
    for scene in point["scenes"]:
        f_max = scene_of(scene).f_max_n
        frames = [t for t, _ in spread_frames(scene, point["seed"], TRAINING_FRAMES)]
        drawn = draw_windows(frames, None, TRAINING_TILE, force_threshold(0.0, f_max), rng)
        parts.append(drawn[: len(drawn) // len(point["scenes"])] * (2.5 / f_max))
    atoms = learn_atoms(np.concatenate(parts), KEPT_FRACTION * 2.5)
    return {"atoms": atoms.astype(np.float32).astype(float).tolist()}


def coefficients(point: Point) -> dict[str, Any]:
    """Count the coefficients of a scene's true forces in each basis.

    `point`: scene, seed, n_frames; bases: names for `make_basis`, by the names on the page.

    Returns
    -------
    dict
        By name: n_nonzero: mean number above rounding, over contact frames; missing: mean part of
        the energy outside the largest coefficients, for each of `KEPT_PARTS`; n_frames.
    """
    rows, cols = scene_of(point["scene"]).shape
    bases = {name: make_basis(basis, rows, cols) for name, basis in point["bases"].items()}
    kept = [max(1, round(part * rows * cols)) for part in KEPT_PARTS]
    counts: dict[str, list[int]] = {name: [] for name in bases}
    missing: dict[str, list[list[float]]] = {name: [] for name in bases}
    for truth, _ in spread_frames(point["scene"], point["seed"], point["n_frames"]):
        if not in_contact(truth, scene_of(point["scene"]).f_max_n):
            continue
        for name, basis in bases.items():
            sizes = np.sort(np.abs(basis.analysis(truth)).reshape(-1))[::-1].astype(np.float64)
            counts[name].append(int(np.count_nonzero(sizes > ROUNDING_N)))
            energy = np.cumsum(sizes**2)
            missing[name].append([max(0.0, 1 - float(energy[k - 1] / energy[-1])) for k in kept])
    return {
        name: {
            "n_nonzero": float(np.mean(counts[name])),
            "missing": np.mean(missing[name], axis=0).tolist(),
            "n_frames": len(counts[name]),
        }
        for name in bases
    }


def reconstructed(point: Point) -> dict[str, Any]:
    """Reconstruct a scene by FISTA in each basis, with each lambda.

    `point`: scene, seed, n_frames, ratio (N / M); bases: as for `coefficients`.

    Returns
    -------
    dict
        By name: mean_db, min_db: over contact frames, one for each of `LAMBDAS_N`.
    """
    scene, ratio, seed = (point[key] for key in ("scene", "ratio", "seed"))
    found = {}
    frames = list(spread_frames(scene, seed, point["n_frames"]))
    for name, basis in point["bases"].items():
        chosen = {"solver": "fista", "basis": basis, "iterations": ITERATIONS}
        methods = {
            str(lambda_n): make_method(
                {**chosen, "lambda_n": lambda_n}, scene_of(scene).shape, ratio, seed, rows=PAPER
            )
            for lambda_n in LAMBDAS_N
        }
        scores = evaluate(methods, frames, scene_of(scene).f_max_n).values()
        found[name] = {
            "mean_db": [round(one.mean_db, 3) for one in scores],
            "min_db": [round(one.min_db, 3) for one in scores],
        }
    return found


def sampled(point: Point) -> dict[str, Any]:
    """Reconstruct a scene, frame after frame, from each kind of sampling.

    `point`: scene, seed, n_frames, ratio (N / M).

    Returns
    -------
    dict
        By the names of `SAMPLINGS`, and "reading" for all taxels as they are read: mean_db,
        min_db, over contact frames.
    """
    scene, ratio, seed = (point[key] for key in ("scene", "ratio", "seed"))
    f_max = scene_of(scene).f_max_n
    chosen = {"interpolation": {"solver": "interpolation", "basis": "identity"}, **PRESETS}
    methods = {
        name: make_method(
            *(chosen[solver], scene_of(scene).shape, ratio, seed),
            rows=PAPER if solver == "paper" else FIXED,
            phi=phi,
            f_max_n=f_max,
        )
        for name, (phi, solver) in SAMPLINGS.items()
    }
    first = max(0, first_contact(scene, seed) - BEFORE)
    frames = scene_frames(scene, seed, first, first + point["n_frames"])
    scores = evaluate({"reading": Reading(), **methods}, frames, f_max)
    return {
        name: {"mean_db": round(one.mean_db, 3), "min_db": round(one.min_db, 3)}
        for name, one in scores.items()
    }
