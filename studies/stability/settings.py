"""Settings of the solvers far beyond both ends: step, lambda, iterations, noise, blocks."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.studies.evaluate import settings_of
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import markdown, write_csv

from .frames import (
    SCORES,
    SHAPE,
    N,
    mean_scores,
    measured,
    read_excerpts,
    reconstruct,
    scores,
    solver_for,
)
from .sweeps import Sweep, draw_sweeps, sweep_points, sweep_table

RATIO = 3
BLOCKS: dict[str, Any] = {
    "values": tuple(2**k for k in range(1, 9)),
    "quick": (2, 32, 256),
    "scale": "log",
}
SWEEPS = {
    "step": Sweep(
        "step, in 1/L",
        np.linspace(0.5, 2.5, 17).tolist(),
        np.linspace(0.5, 2.5, 5).tolist(),
        edges={"4/3: momentum": 4 / 3, "2: none": 2.0},
    ),
    "lambda_n": Sweep(
        "λ, N",
        np.geomspace(1e-4, 1.0, 17).tolist(),
        np.geomspace(1e-4, 1.0, 5).tolist(),
        scale="log",
    ),
    "iterations": Sweep(
        "iterations a frame", (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 100), (1, 5, 20), scale="log"
    ),
    "noise": Sweep(
        "noise, times the paper's",
        (0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0),
        (0.0, 1.0, 10.0),
        against_readings=True,
    ),
    "block": Sweep("block size B", **BLOCKS),
    "unscrambled": Sweep("block size B, unscrambled", **BLOCKS),
}


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Every solver over each setting that it has, the others as they are in the project."""
    ratios = (RATIO,) if quick else (RATIO, 8)
    sweeps = SWEEPS | {"subsample": Sweep("", (1,), (1,))}
    return [
        {**point, "ratio": ratio, "seed": seed}
        for point in sweep_points(sweeps, quick)
        if point["sweep"] not in ("lambda_n", "iterations")
        or point["sweep"] in settings_of(point["solver"])
        for ratio in ratios
    ]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """`SCORES` of a solver, means over the excerpts, dB; and the share of frames that blew up."""
    name, sweep, value = point["solver"], point["sweep"], point["value"]
    m = int(N / point["ratio"])
    changed = {sweep: value} if sweep in ("lambda_n", "iterations") else {}
    if sweep == "iterations" and "max_iterations" in settings_of(name):
        changed["max_iterations"] = max(value, settings_of(name)["max_iterations"].default)
    factor = value if sweep == "noise" else 1.0
    found, n_blown_up, n_frames = [], 0, 0
    for truth, readings, _ in read_excerpts(point["seed"], factor):
        phi = _phi(sweep, value, m, point["seed"])
        frames = reconstruct(solver_for(name, phi, SHAPE, **changed), measured(phi, readings))
        n_blown_up += int(np.count_nonzero(~np.isfinite(frames).all(axis=(1, 2))))
        n_frames += len(frames)
        found.append(scores(frames, readings, truth))
    return {**mean_scores(found), "blown_up": n_blown_up / n_frames}


def _phi(sweep: str, value: float, m: int, seed: int) -> Phi:
    if sweep == "step":
        return LongRows(N, m, seed, value)
    if sweep == "unscrambled":
        return Unscrambled(N, m, seed, int(value))
    if sweep == "subsample":
        return make_phi("subsample", N, m, seed)
    return make_phi("sbhe", N, m, seed, block=int(value) if sweep == "block" else 32)


def section(out: Path, quick: bool, seed: int, executor: str) -> dict[str, Any]:
    """Compute and draw; the values for the page."""
    rows = compute_rows(measure, points(quick, seed), out, executor, "settings")
    frame = pd.DataFrame(rows)
    charts = []
    for ratio, some in frame.groupby("ratio", sort=False):
        caption = f"Settings, M = N/{ratio}."
        chart = draw_sweeps(out, f"settings_n{ratio}", caption, some, SWEEPS)
        charts += [chart, markdown(sweep_table(some, SWEEPS))]
    single = frame[frame["sweep"] == "subsample"]
    columns = ("PSNR, dB", "where touched, dB", "readings: PSNR", "where touched")
    scored = single[list(SCORES)].map("{:.1f}".format).set_axis(columns, axis=1)
    scored.insert(0, "solver", single["solver"])
    scored.insert(1, "M", "N/" + single["ratio"].astype(str))
    return {"charts": charts, "single_taxels": scored, "csv": write_csv(out, "settings", rows)}


class LongRows(Phi):
    """Scrambled block Hadamard with rows longer than the length 1 that it states.

    A solver then takes steps of `times` / L, L being the true largest eigenvalue.
    """

    kind = "long rows"

    def __init__(self, n: int, m: int, seed: int, times: float) -> None:
        super().__init__(n, m, seed)
        self._honest = SbhePhi(n, m, seed)
        self._length = np.float32(math.sqrt(times))
        self.fingerprint = self._honest.fingerprint

    def dense(self) -> npt.NDArray[np.float64]:
        return self._honest.dense() * float(self._length)

    def _forward(self, x: Floats, out: Floats) -> None:
        np.multiply(self._honest.forward(x), self._length, out=out)

    def _adjoint(self, y: Floats, out: Floats) -> None:
        np.multiply(self._honest.adjoint(y), self._length, out=out)


class Unscrambled(Phi):
    """Block Hadamard on neighbours along the rows of the skin: Q_M W without P_N."""

    kind = "unscrambled"

    def __init__(self, n: int, m: int, seed: int, block: int = 32) -> None:
        super().__init__(n, m, seed, block)
        self._scrambled = SbhePhi(n, m, seed, block)
        self._permutation = self._scrambled.permutation
        self.fingerprint = self._scrambled.fingerprint

    def dense(self) -> npt.NDArray[np.float64]:
        matrix = np.empty((self.m, self.n))
        matrix[:] = self._scrambled.dense()[:, self._permutation]
        return matrix

    def _forward(self, x: Floats, out: Floats) -> None:
        # Place j of the permuted frame is to hold taxel j itself.
        placed = np.empty_like(x)
        placed[self._permutation] = x
        self._scrambled.forward(placed, out)

    def _adjoint(self, y: Floats, out: Floats) -> None:
        self._scrambled.adjoint(y).take(self._permutation, out=out)
