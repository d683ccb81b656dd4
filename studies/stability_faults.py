"""What breaks on the way: taxels, a measurement row, frames, bits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.sensor.noise import PAPER_SIGMA_END_N
from sparseskin.studies.solvers import SUM_SOLVERS
from sparseskin.studies.stability_frames import (
    EXCERPTS,
    F_MAX_N,
    SCORES,
    SHAPE,
    excerpt,
    measured,
    read,
    restore,
    score,
    solver_for,
)

N = math.prod(SHAPE)
M = N // 3
BLOCK = 32
BURST = 10
TAXEL_FAULTS = ("dead", "masked", "stuck", "saturated")
Bools = npt.NDArray[np.bool_]


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Every solver under each fault, from none to far too much."""
    shares = (0.0, 0.02, 0.2) if quick else (0.0, 0.001, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
    lost = (0.0, 0.5) if quick else (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
    levels: dict[str, Any] = {
        **dict.fromkeys(TAXEL_FAULTS, shares),
        "rows": (0, 1, 10) if quick else (0, 1, 2, 5, 10, 20, 50),
        "lost singly": lost,
        "lost in bursts": lost,
        "bits": (4, 8) if quick else (4, 5, 6, 7, 8, 10, 12, 16),
        "converter": (4, 8, 12) if quick else tuple(range(4, 17)),
    }
    return [
        {"sweep": fault, "value": level, "solver": solver, "seed": seed}
        for solver in SUM_SOLVERS
        for fault, values in levels.items()
        for level in values
    ]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """PSNR of the contact frames and SNR over the touched taxels, means over the excerpts, dB:
    of what is restored, and of readings without the fault; over living taxels only.
    """
    fault, level = point["sweep"], point["value"]
    scores = []
    for k in range(len(EXCERPTS)):
        rng = np.random.default_rng((point["seed"], k))
        truth = excerpt(k)
        readings = read(truth, rng)
        faulty = readings.copy()
        alive = np.ones(SHAPE, np.bool_)
        if fault in TAXEL_FAULTS:
            alive.reshape(-1)[rng.permutation(N)[: round(level * N)]] = False
            faulty[:, ~alive] = _reading(fault, int(np.count_nonzero(~alive)), rng)
        mask = alive if fault == "masked" else None
        n = N if mask is None else int(np.count_nonzero(mask))
        phi = make_phi("sbhe", n, n // 3, seed=point["seed"], block=BLOCK)
        ys = measured(phi, faulty, mask)
        if fault == "rows":
            ys[:, rng.permutation(M)[:level]] = 0.0
        if fault == "bits":
            ys = np.stack([np.asarray(quantised(y, level)) for y in ys])
        if fault == "converter":
            ys = converted(ys, level)
        arrives = arrivals(fault, level, len(truth), rng)
        solver = solver_for(point["solver"], phi, SHAPE, mask)
        restored = restore(solver, ys[arrives])
        # What was lost is not restored: the last frame stands until the next one comes.
        last = np.maximum.accumulate(np.where(arrives, np.cumsum(arrives) - 1, 0))
        scores.append((*score(restored[last], truth, alive), *score(readings, truth, alive)))
    return dict(zip(SCORES, np.mean(scores, axis=0).tolist(), strict=True))


def converted(ys: Floats, bits: int) -> Floats:
    """Measurements as a converter of so many bits gives them.

    Its range holds whatever a row of a block of 32 can sum up to: a row of ones 32 f_max, a
    row of both signs 16 f_max either way, over sqrt(32).
    """
    step = converter_step_n(bits)
    rounded: Floats = (step * np.round(ys / step)).astype(np.float32)
    return rounded


def converter_step_n(bits: int) -> float:
    """What one step of the converter is, N."""
    low, high = -BLOCK / 2, BLOCK
    return float((high - low) * F_MAX_N / math.sqrt(BLOCK) / 2**bits)


def bits_of_the_noise() -> float:
    """Bits at which the steps make as much noise as an untouched taxel has."""
    return math.log2(converter_step_n(0) / math.sqrt(12.0) / PAPER_SIGMA_END_N)


def _reading(fault: str, n_taxels: int, rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """What broken taxels say all the time, N."""
    if fault == "stuck":
        return rng.uniform(0.0, F_MAX_N, n_taxels)
    return np.full(n_taxels, F_MAX_N if fault == "saturated" else 0.0)


def arrivals(fault: str, share: float, n_frames: int, rng: np.random.Generator) -> Bools:
    """Which frames arrive; the first one always does."""
    arrives = np.ones(n_frames, np.bool_)
    if fault == "lost singly":
        arrives = rng.random(n_frames) >= share
    elif fault == "lost in bursts":
        # Gaps of BURST frames, begun so often that the stated share is lost.
        begin = share / (BURST * (1.0 - share))
        left = 0
        for t in range(n_frames):
            left = left - 1 if left else (BURST if rng.random() < begin else 0)
            arrives[t] = left == 0
    arrives[0] = True
    return arrives
