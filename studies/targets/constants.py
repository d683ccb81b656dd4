"""What single constants of the default solver are worth: error and PSNR without each.

Run as `python -m sparseskin.studies.targets.constants --recordings DIR [CHANGE ...]`.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING, m_of, row_subsets
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.reconstructor.skin.tuning import TUNING, SkinTuning
from sparseskin.studies.evaluate import in_contact
from sparseskin.studies.real.recordings import LOADED, files_in, part_of
from sparseskin.studies.scene_frames import scene_frames, scene_of

#: First of 80 frames of each scene.
SCENES = {"lift_box_40": 315, "lift_wrench_40": 315, "drag_wrench_40": 1500, "path_40": 315}
N_SCENE, N_RECORDED, N_BEFORE = 80, 100, 8
RATIOS = (3, 8)
#: Changes that leave a constant out, as near as a value of it can.
LEFT_OUT: dict[str, dict[str, Any]] = {
    "bias_forgotten = 1": {"bias_forgotten": 1.0},
    "bias_slowest = 0": {"bias_slowest": 0.0},
    "median_first = 0, median_every infinite": {"median_first": 0, "median_every": 10**9},
    "motion_still = 0": {"motion_still": 0.0},
    "failed_noise = 0": {"failed_noise": 0.0},
    "noise_rate = 1": {"noise_rate": 1.0},
    "noise_growth infinite": {"noise_growth": math.inf},
    "noise_growth_rotating = noise_growth": {"noise_growth_rotating": TUNING.noise_growth},
    "noise_clearly = 0": {"noise_clearly": 0.0},
    "noise_relearned = 0": {"noise_relearned": 0},
    "gain_expected = 1": {"gain_expected": 1.0},
    "gain_least = 0": {"gain_least": 0.0},
    "lagging = 0": {"lagging": 0.0},
    "trust_least = 1": {"trust_least": 1.0},
    "trust_least = 0": {"trust_least": 0.0},
    "memory_weight = 0": {"memory_weight": 0.0},
    "memory_doubt = 1": {"memory_doubt": 1.0},
    "drift_decay = 0": {"drift_decay": 0.0},
    "least_threshold = 0": {"least_threshold": 0.0},
    "held thresholds = 0": {"held_threshold": 0.0, "held_rotating": 0.0},
    "held_rotating = held_threshold": {"held_rotating": TUNING.held_threshold},
    "cold_threshold infinite": {"cold_threshold": math.inf},
    "settling = 0": {"settling": 0},
    "momentum = 0": {"momentum": 0.0},
    "averaged = 1": {"averaged": 1},
    "lengths = 1": {"lengths": (1.0,)},
    "model_error = 0": {"model_error": 0.0},
    "least_noise = 0": {"least_noise": 0.0},
    "kept_fixed = kept_rotating": {"kept_fixed": TUNING.kept_rotating},
    "kept_rotating = kept_fixed": {"kept_rotating": TUNING.kept_fixed},
    "cold_rounds = rounds": {"cold_rounds": TUNING.rounds},
    "cold_gradients = gradients": {"cold_gradients": TUNING.gradients},
    "precise = 0": {"precise": 0.0},
    "error_memory = 0": {"error_memory": 0.0},
    "error_fading infinite": {"error_fading": math.inf},
    "margin = 0": {"margin": 0.0},
    "worse infinite": {"worse": math.inf},
}


class Stream(NamedTuple):
    """Readings, true forces, the taxels that exist, and norm above which a frame is loaded; or
    None and f_max of a scene.
    """

    name: str
    taxels: Floats
    truth: Floats
    mask: Mask
    loaded: float | None
    f_max: float


def streams(recordings: Path) -> Iterator[Stream]:
    """Yield 80 frames of each scene, and 100 of each recording from the begin of its load."""
    for scene, first in SCENES.items():
        pairs = list(scene_frames(scene, 0, first, first + N_SCENE))
        truth, taxels = (np.stack(frames) for frames in zip(*pairs, strict=True))
        mask = np.ones(truth.shape[1:], dtype=np.bool_)
        yield Stream(scene, taxels, truth, mask, None, scene_of(scene).f_max_n)
    for path in files_in(recordings):
        part = part_of(str(path), 300)
        norms = np.linalg.norm(part.frames.reshape(len(part.frames), -1), axis=1)
        begin = int(np.argmax(norms > LOADED * part.norm)) - N_BEFORE
        begin = max(0, min(begin, len(norms) - N_RECORDED))
        chosen = slice(begin, begin + N_RECORDED)
        loaded = LOADED * part.norm
        taxels, truth = part.frames[chosen], part.truth[chosen]
        yield Stream(path.stem, taxels, truth, part.skin.mask, loaded, part.skin.f_max)


def figure(stream: Stream, ratio: int, rows: str, tuning: SkinTuning) -> float:
    """Return the mean PSNR of contact frames, dB, or the median relative error of loaded ones."""
    n = int(np.count_nonzero(stream.mask))
    subsets = row_subsets(make_phi("sbhe", n, m_of(n, ratio, rows), seed=0), rows)
    basis = make_basis("haar", *stream.mask.shape)
    solver, found = SkinSolver(subsets[0], basis, stream.mask, tuning=tuning), []
    for k, (taxels, truth) in enumerate(zip(stream.taxels, stream.truth, strict=True)):
        phi = subsets[k % len(subsets)]
        solver.use(phi)
        error = solver.solve(phi.forward(taxels[stream.mask])) - truth
        distance = float(np.linalg.norm(error[stream.mask]))
        norm = float(np.linalg.norm(truth[stream.mask]))
        if stream.loaded is None and in_contact(truth, stream.f_max):
            found.append(psnr_db(error[stream.mask], stream.f_max))
        elif stream.loaded is not None and k >= N_BEFORE and norm > stream.loaded:
            found.append(distance / norm)
    return float(np.mean(found) if stream.loaded is None else np.median(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("changes", nargs="*", help=f"some of: {'; '.join(LEFT_OUT)}")
    given = parser.parse_args()
    kinds = [
        (one, ratio, rows)
        for one in streams(given.recordings)
        for ratio in RATIOS
        for rows in (FIXED, ROTATING)
    ]
    base = [figure(*kind, TUNING) for kind in kinds]
    print("| left out | error, fixed % | error, rotating % | worst % | PSNR dB | worst dB |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name in given.changes or LEFT_OUT:
        tuning = replace(TUNING, **LEFT_OUT[name])
        errors: dict[str, list[float]] = {FIXED: [], ROTATING: []}
        psnr = []
        for kind, before in zip(kinds, base, strict=True):
            now = figure(*kind, tuning)
            if kind[0].loaded is None:
                psnr.append(now - before)
            else:
                errors[kind[2]].append(100 * (now / before - 1))
        worst = max(errors[FIXED] + errors[ROTATING])
        fixed, rotating = (float(np.mean(errors[rows])) for rows in (FIXED, ROTATING))
        print(
            f"| {name} | {fixed:+.1f} | {rotating:+.1f} | {worst:+.0f} "
            f"| {np.mean(psnr):+.2f} | {min(psnr):+.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
