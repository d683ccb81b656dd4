"""What a user can set, far beyond both ends: step, lambda, iterations, noise, blocks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.phi import Phi, make_phi
from sparseskin.studies.solvers import SUM_SOLVERS
from sparseskin.studies.stability_frames import (
    EXCERPTS,
    SCORES,
    SHAPE,
    default_of,
    excerpt,
    measured,
    read,
    restore,
    score,
    solver_for,
    takes,
)
from sparseskin.studies.stability_phis import LongRows, Unscrambled

N = math.prod(SHAPE)
RATIO = 3


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Every solver over each setting that it has, the others as they are in the project."""
    ratios = (RATIO,) if quick else (RATIO, 8)
    sweeps: dict[str, Any] = {
        "step": np.linspace(0.5, 2.5, 5 if quick else 17).tolist(),
        "lambda_n": np.geomspace(1e-4, 1.0, 5 if quick else 17).tolist(),
        "iterations": (1, 5, 20) if quick else (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 100),
        "noise": (0.0, 1.0, 10.0) if quick else (0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0),
        "block": (2, 32, 256) if quick else tuple(2**k for k in range(1, 9)),
        "unscrambled": (2, 32, 256) if quick else tuple(2**k for k in range(1, 9)),
        "subsample": (1,),
    }
    return [
        {"sweep": sweep, "value": value, "solver": solver, "ratio": ratio, "seed": seed}
        for solver in SUM_SOLVERS
        for sweep, values in sweeps.items()
        if sweep not in ("lambda_n", "iterations") or takes(solver, sweep)
        for value in values
        for ratio in ratios
    ]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """PSNR of the contact frames and SNR over the touched taxels, means over the excerpts, dB:
    of what is restored and of the readings; and the share of frames that blew up.
    """
    sweep, value = point["sweep"], point["value"]
    m = int(N / point["ratio"])
    changed = {sweep: value} if sweep in ("lambda_n", "iterations") else {}
    if sweep == "iterations" and takes(point["solver"], "max_iterations"):
        changed["max_iterations"] = max(value, default_of(point["solver"], "max_iterations"))
    factor = value if sweep == "noise" else 1.0
    scores, n_blown_up = [], 0
    for k in range(len(EXCERPTS)):
        truth = excerpt(k)
        readings = read(truth, np.random.default_rng((point["seed"], k)), factor)
        phi = _phi(sweep, value, m, point["seed"])
        solver = solver_for(point["solver"], phi, SHAPE, **changed)
        restored = restore(solver, measured(phi, readings))
        n_blown_up += int(np.count_nonzero(~np.isfinite(restored).all(axis=(1, 2))))
        scores.append((*score(restored, truth), *score(readings, truth)))
    means = dict(zip(SCORES, np.mean(scores, axis=0).tolist(), strict=True))
    return {**means, "blown_up": n_blown_up / sum(len(excerpt(k)) for k in range(len(EXCERPTS)))}


def _phi(sweep: str, value: float, m: int, seed: int) -> Phi:
    if sweep == "step":
        return LongRows(N, m, seed, value)
    if sweep == "unscrambled":
        return Unscrambled(N, m, seed, int(value))
    if sweep == "subsample":
        return make_phi("subsample", N, m, seed)
    return make_phi("sbhe", N, m, seed, block=int(value) if sweep == "block" else 32)
