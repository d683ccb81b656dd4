"""Sudden change: how many frames a solver needs after first contact, slip and release."""

from __future__ import annotations

from typing import Any

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.studies.solvers import SUM_SOLVERS
from sparseskin.studies.stability_frames import (
    F_MAX_N,
    contacts,
    frame_errors,
    measured,
    read,
    restore,
    solver_for,
)

EVENTS = ("first contact", "slip", "release")
N_BEFORE, N_EACH, N_SETTLED = 10, 30, 10
SLIP_TAXELS = 5
#: Mean squared error, N^2, that is good enough to be called settled: 60 dB of PSNR.
GOOD = F_MAX_N**2 * 1e-6
#: K/M of the pads: within what l1 can find at each of the ratios.
RHO = 0.12


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Every solver at several N/M; in full, on the larger skin too."""
    sides = (40,) if quick else (40, 64)
    ratios = (3,) if quick else (3, 4, 8)
    return [
        {
            "solver": solver,
            "side": side,
            "ratio": ratio,
            "n_trials": 4 if quick else 12,
            "seed": seed,
        }
        for solver in SUM_SOLVERS
        for side in sides
        for ratio in ratios
    ]


def sequence(side: int, n_coefficients: int, rng: np.random.Generator) -> Floats:
    """True forces, N: nothing; pads at once; pads moved by 5 taxels at once; nothing at once."""
    pads = contacts((side - SLIP_TAXELS, side - SLIP_TAXELS), n_coefficients, rng)
    frames = np.zeros((N_BEFORE + len(EVENTS) * N_EACH, side, side), np.float32)
    end = side - SLIP_TAXELS
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
        restored = restore(solver_for(point["solver"], phi, (side, side)), measured(phi, readings))
        total += np.minimum(frame_errors(restored, truth), 1e6)
        noisy += frame_errors(readings, truth)
    return {
        "errors": (total / point["n_trials"]).tolist(),
        "noisy": (noisy / point["n_trials"]).tolist(),
    }


def frames_until_settled(errors: list[float]) -> dict[str, int]:
    """Frames from each event until the error stays within 1 dB of where it settles.

    1: at once, with the event's own frame. What is below `GOOD` counts as settled.
    """
    frames = {}
    for k, event in enumerate(EVENTS):
        start = N_BEFORE + k * N_EACH
        after = [max(error, GOOD) for error in errors[start : start + N_EACH]]
        settled = float(np.mean(after[-N_SETTLED:]))
        off = [i for i, error in enumerate(after) if error > 10**0.1 * settled]
        frames[event] = off[-1] + 2 if off else 1
    return frames
