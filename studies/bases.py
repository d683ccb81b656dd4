"""`sparseskin study bases`: in which basis a skin's forces are sparse, and other ways to sample."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.nodes.reconstructor.basis import LEARNED
from sparseskin.nodes.reconstructor.learned_training import haar_atoms

from .bases_page import write
from .bases_points import TRAINING_TILE, coefficients, learned, restored, sampled
from .points import StudyError, compute

#: The body that presses in each scene.
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

Point = dict[str, Any]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the study and write its page.

    Parameters
    ----------
    out : Path
        Folder for the page, its tables, charts and learned bases.
    quick : bool
        Two scenes, and few frames of them.
    seed : int
        Seed of noise and Phi; bases are learned from scenes of the next seed.
    executor : str
        Where points are computed.

    Raises
    ------
    StudyError
        If a point fails or a file cannot be written.
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
    registered[TILED] = _saved(out, "haar_tiles", haar_atoms(TRAINING_TILE))
    counting: list[Point] = [
        {
            "scene": scene,
            "bases": registered
            | {
                name: file_of[str(point)]
                for name, point in zip(LEARNED_BASES, training_of(scene, seed), strict=True)
            },
            "n_frames": QUICK_FRAMES if quick else N_FRAMES,
            "seed": seed,
        }
        for scene in scenes
    ]
    restoring = [{**point, "ratio": ratio} for point in counting for ratio in RATIOS]
    sampling: list[Point] = [
        {
            "scene": scene,
            "ratio": ratio,
            "n_frames": QUICK_SAMPLED_FRAMES if quick else SAMPLED_FRAMES,
            "seed": seed,
        }
        for scene in scenes
        for ratio in (QUICK_SAMPLED_RATIOS if quick else SAMPLED_RATIOS)
    ]
    counted = zip(counting, compute(coefficients, counting, out, executor, "count"), strict=True)
    found = zip(restoring, compute(restored, restoring, out, executor, "restore"), strict=True)
    other = zip(sampling, compute(sampled, sampling, out, executor, "sample"), strict=True)
    write(
        out,
        counted={(p["scene"], name): f for p, by_name in counted for name, f in by_name.items()},
        restored={
            (p["scene"], name, p["ratio"]): f for p, by_name in found for name, f in by_name.items()
        },
        sampled={(p["scene"], p["ratio"]): figures for p, figures in other},
    )


def training_of(scene: str, seed: int) -> list[Point]:
    """What the bases that are tried on a scene are learned from, in the order of their names."""
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
