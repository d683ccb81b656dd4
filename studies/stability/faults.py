"""Faults between skin and solver: taxels, a measurement, frames, bits."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.noise import PAPER_SIGMA_END_N
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import write_csv

from .frames import SHAPE, N, mean_scores, measured, read_excerpts, reconstruct, scores, solver_for
from .sweeps import Sweep, draw_sweeps, sweep_points, sweep_table

M = N // 3
BLOCK = 32
BURST = 10
TAXEL_FAULTS = ("dead", "masked", "stuck", "saturated")


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Every solver under each fault, from none to far too much."""
    return [{**point, "seed": seed} for point in sweep_points(SWEEPS, quick)]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """`SCORES` of a solver, means over the excerpts, dB: of reconstructed frames, and of readings
    without the fault; over taxels without a fault only.
    """
    fault, level = point["sweep"], point["value"]
    found = []
    for truth, readings, rng in read_excerpts(point["seed"]):
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
        frames = reconstruct(solver_for(point["solver"], phi, SHAPE, mask), ys[arrives])
        # While frames are lost, the last reconstructed one stands.
        last = np.maximum.accumulate(np.where(arrives, np.cumsum(arrives) - 1, 0))
        found.append(scores(frames[last], readings, truth, alive))
    return mean_scores(found)


def converted(ys: Floats, bits: int) -> Floats:
    """Measurements as a converter of that many bits returns them.

    Its range holds any sum of a row over a block of 32: 32 f_max for a row of ones, 16 f_max
    either way for a row of both signs, over sqrt(32).
    """
    step = converter_step_n(bits)
    rounded: Floats = (step * np.round(ys / step)).astype(np.float32)
    return rounded


def converter_step_n(bits: int) -> float:
    """One step of the converter, N."""
    low, high = -BLOCK / 2, BLOCK
    return float((high - low) * PAPER_F_MAX_N / math.sqrt(BLOCK) / 2**bits)


def bits_of_the_noise() -> float:
    """Bits at which the steps make as much noise as an untouched taxel has."""
    return math.log2(converter_step_n(0) / math.sqrt(12.0) / PAPER_SIGMA_END_N)


def _reading(fault: str, n_taxels: int, rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Constant readings of faulty taxels, N."""
    if fault == "stuck":
        return rng.uniform(0.0, PAPER_F_MAX_N, n_taxels)
    return np.full(n_taxels, PAPER_F_MAX_N if fault == "saturated" else 0.0)


def arrivals(
    fault: str, share: float, n_frames: int, rng: np.random.Generator
) -> npt.NDArray[np.bool_]:
    """True for each frame that arrives; the first one always does."""
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


SHARES = ((0.0, 0.001, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2), (0.0, 0.02, 0.2))
LOST = ((0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5), (0.0, 0.5))
SWEEPS = {
    "dead": Sweep("share of taxels dead", *SHARES),
    "masked": Sweep("share of taxels dead, in the mask", *SHARES),
    "stuck": Sweep("share of taxels stuck", *SHARES),
    "saturated": Sweep("share of taxels saturated", *SHARES),
    "rows": Sweep("measurements that read 0", (0, 1, 2, 5, 10, 20, 50), (0, 1, 10)),
    "lost singly": Sweep("share of frames lost, singly", *LOST),
    "lost in bursts": Sweep("share of frames lost, in bursts", *LOST),
    "bits": Sweep("bits of a measurement", (4, 5, 6, 7, 8, 10, 12, 16), (4, 8)),
    "converter": Sweep(
        "bits of the converter",
        range(4, 17),
        (4, 8, 12),
        edges={"noise of the skin": bits_of_the_noise()},
    ),
}


def section(out: Path, quick: bool, seed: int, executor: str) -> dict[str, Any]:
    """Compute and draw; the values for the page."""
    rows = compute_rows(measure, points(quick, seed), out, executor, "faults")
    frame = pd.DataFrame(rows)
    return {
        "chart": draw_sweeps(out, "faults", "Faults, M = N/3.", frame, SWEEPS),
        "table": sweep_table(frame, SWEEPS),
        "csv": write_csv(out, "faults", rows),
    }
