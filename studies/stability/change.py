"""Sudden change: frames that a solver needs after first contact, slip and release."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import Page, cells

from .excerpts import contacts, frame_errors, measured, psnr_of, read, reconstruct, solver_for

EVENTS = ("first contact", "slip", "release")
N_BEFORE, N_EACH, N_SETTLED = 10, 30, 10
SLIP_TAXELS = 5
GOOD = PAPER_F_MAX_N**2 * 1e-6
"""Mean squared error, N^2, that counts as settled: 60 dB of PSNR."""
RHO = 0.12
"""K/M of the pads: within what l1 can find at each of the ratios."""


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Every solver at several N/M; in full, on the larger skin too."""
    n_trials = 4 if quick else 12
    return [
        {"solver": solver, "side": side, "ratio": ratio, "n_trials": n_trials, "seed": seed}
        for solver in SUM_SOLVERS
        for side in ((40,) if quick else (40, 64))
        for ratio in ((3,) if quick else (3, 4, 8))
    ]


def sequence(side: int, n_coefficients: int, rng: np.random.Generator) -> Floats:
    """True forces, N: nothing; pads at once; pads moved by 5 taxels at once; nothing at once."""
    end = side - SLIP_TAXELS
    pads = contacts((end, end), n_coefficients, rng)
    frames = np.zeros((N_BEFORE + len(EVENTS) * N_EACH, side, side), np.float32)
    frames[N_BEFORE : N_BEFORE + N_EACH, :end, :end] = pads
    frames[N_BEFORE + N_EACH : N_BEFORE + 2 * N_EACH, SLIP_TAXELS:, SLIP_TAXELS:] = pads
    return frames


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Mean squared error of each frame, N^2, averaged over trials with pads of their own."""
    side, n = point["side"], point["side"] ** 2
    m = int(n / point["ratio"])
    total = np.zeros(N_BEFORE + len(EVENTS) * N_EACH)
    noisy = np.zeros_like(total)
    for trial in range(point["n_trials"]):
        rng = np.random.default_rng((point["seed"], trial))
        truth = sequence(side, round(RHO * m), rng)
        readings = read(truth, rng)
        phi = make_phi("sbhe", n, m, seed=trial)
        frames = reconstruct(
            solver_for(point["solver"], phi, (side, side)), measured(phi, readings)
        )
        total += np.minimum(frame_errors(frames, truth), 1e6)
        noisy += frame_errors(readings, truth)
    return {
        "errors": (total / point["n_trials"]).tolist(),
        "noisy": (noisy / point["n_trials"]).tolist(),
    }


def frames_until_settled(errors: list[float]) -> dict[str, int]:
    """Frames from each event until the error stays within 1 dB of where it settles.

    1: at once, with the event's own frame. Errors below `GOOD` count as settled.
    """
    frames = {}
    for k, event in enumerate(EVENTS):
        start = N_BEFORE + k * N_EACH
        after = [max(error, GOOD) for error in errors[start : start + N_EACH]]
        settled = float(np.mean(after[-N_SETTLED:]))
        off = [i for i, error in enumerate(after) if error > 10**0.1 * settled]
        frames[event] = off[-1] + 2 if off else 1
    return frames


def section(page: Page, quick: bool, seed: int, executor: str) -> pd.DataFrame:
    """Compute and add the section; figures of each event."""
    found = compute_rows(measure, points(quick, seed), page.out, executor, "sudden change")
    rows = pd.DataFrame([row for one in found for row in _rows(one)])
    page.csv("change", rows)
    text = "{frames_until_settled} / {below_readings} ({first_db:.1f}, {settled_db:.1f})"
    sides, ratios = cells(rows, "{side} x {side}"), cells(rows, "N/{ratio}")
    shown = rows.assign(taxels=sides, M=ratios, cell=cells(rows, text))
    shown = shown.sort_values(["side", "ratio"], kind="stable")
    keys = ["taxels", "M", "solver"]
    table = shown.pivot_table("cell", keys, "event", aggfunc="first", sort=False).reset_index()
    page.section("Solvers: sudden change", table, n_each=N_EACH)
    return rows


def _rows(one: dict[str, Any]) -> list[dict[str, Any]]:
    """Figures of each event, of one point with its errors."""
    settled = frames_until_settled(one["errors"])
    rows = []
    for k, event in enumerate(EVENTS):
        start = N_BEFORE + k * N_EACH
        errors, noisy = (one[key][start : start + N_EACH] for key in ("errors", "noisy"))
        rows.append(
            {
                **{key: one[key] for key in ("solver", "side", "ratio", "n_trials", "seed")},
                **{"event": event, "frames_until_settled": settled[event]},
                "below_readings": sum(e > n for e, n in zip(errors, noisy, strict=True)),
                "first_db": psnr_of(errors[0]),
                "settled_db": float(np.mean([psnr_of(e) for e in errors[-N_SETTLED:]])),
            }
        )
    return rows
