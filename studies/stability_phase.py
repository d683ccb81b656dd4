"""How many measurements a frame needs: the phase transition over M/N and K/M."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.reconstructor.basis import make_basis
from sparseskin.nodes.reconstructor.fista import FistaSolver
from sparseskin.studies.solvers import SUM_SOLVERS
from sparseskin.studies.stability_frames import (
    SHAPE,
    contacts,
    count_coefficients,
    frame_errors,
    mean_psnr,
    measured,
    read,
    restore,
    solver_for,
)

L1_SHAPE = (32, 32)
#: Success: the relative error of the coefficients, which the small lambda alone keeps at 0.01.
L1_ERROR = 0.03
L1_LAMBDA, L1_ITERATIONS, L1_CALLS = 1e-3, 300, 4
N_STATIC, N_JUDGED = 24, 8
#: Fewer coefficients than these no pad of whole taxels has, at a place of its own.
LEAST_K = 13


def l1_points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """FISTA at its end, on coefficients at random places, over M/N and K/M.

    The dense Gaussian matrix, for which the theory is proven, has a coarser grid: it is slow.
    """
    grids = {
        "sbhe": (6, 9, 3) if quick else (12, 19, 10),
        "gaussian": (2, 4, 1) if quick else (5, 10, 4),
    }
    return [
        {"phi": phi, "delta": delta, "rho": rho, "n_trials": n_trials, "seed": seed}
        for phi, (n_deltas, n_rhos, n_trials) in grids.items()
        for delta in np.linspace(0.08, 0.96, n_deltas).round(4).tolist()
        for rho in np.linspace(0.04, 0.76, n_rhos).round(4).tolist()
    ]


def measure_l1(point: dict[str, Any]) -> dict[str, Any]:
    """Share of K-sparse sets of coefficients that FISTA finds from M exact measurements."""
    n = math.prod(L1_SHAPE)
    m = round(point["delta"] * n)
    k = max(1, round(point["rho"] * m))
    basis = make_basis("haar", *L1_SHAPE)
    found = 0
    for trial in range(point["n_trials"]):
        rng = np.random.default_rng((point["seed"], trial, m, k))
        theta = np.zeros(n, np.float32)
        theta[rng.choice(n, k, replace=False)] = rng.standard_normal(k)
        phi = make_phi(point["phi"], n, m, seed=trial)
        solver = FistaSolver(phi, basis, iterations=L1_ITERATIONS, lambda_n=L1_LAMBDA)
        y = phi.forward(basis.synthesis(theta.reshape(L1_SHAPE)).ravel())
        # Momentum starts anew with each call, which quickens the end of the way. Its forces
        # would be cut at 0, so the coefficients themselves are looked at.
        for _ in range(L1_CALLS):
            solver.solve(y)
        error = np.linalg.norm(solver.theta.ravel() - theta) / np.linalg.norm(theta)
        found += bool(error < L1_ERROR)
    return {"k": k, "m": m, "success": found / point["n_trials"]}


def weak_threshold(delta: float) -> float:
    """K/M up to which l1 finds nearly all K-sparse signals from a share delta = M/N.

    Source: Donoho, Tanner, J. AMS 22 (2009), the weak threshold of the cross-polytope, in the
    parametric form of Donoho, Maleki, Montanari, PNAS 106 (2009), eq. 4 and 5.
    """

    def negative_rho(z: float) -> float:
        tail = (1.0 + z * z) * norm.cdf(-z) - z * norm.pdf(z)
        return -float((1.0 - 2.0 / delta * tail) / (1.0 + z * z - 2.0 * tail))

    found = minimize_scalar(negative_rho, bounds=(0.0, 8.0), method="bounded")
    return -float(found.fun)


def skin_points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Every solver on pads at random places, with the skin's noise."""
    ratios = (16, 8, 4, 2) if quick else (32, 16, 12, 8, 6, 4, 3, 2, 1.5)
    rhos = (0.1, 0.3, 0.6) if quick else (0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.55, 0.75)
    n_trials = 1 if quick else 3
    return [
        {"solver": solver, "delta": 1 / ratio, "rho": rho, "n_trials": n_trials, "seed": seed}
        for solver in SUM_SOLVERS
        for ratio in ratios
        for rho in rhos
        if rho * math.prod(SHAPE) / ratio >= LEAST_K
    ]


def measure_skin(point: dict[str, Any]) -> dict[str, Any]:
    """PSNR of a settled restoration, less that of the readings, over static frames."""
    n = math.prod(SHAPE)
    m = round(point["delta"] * n)
    gains, counts = [], []
    for trial in range(point["n_trials"]):
        rng = np.random.default_rng((point["seed"], trial, m, round(1000 * point["rho"])))
        frame = contacts(SHAPE, round(point["rho"] * m), rng)
        counts.append(count_coefficients(make_basis("haar", *SHAPE).analysis(frame)))
        truth = np.broadcast_to(frame, (N_STATIC, *SHAPE))
        readings = read(truth, rng)
        phi = make_phi("sbhe", n, m, seed=trial)
        restored = restore(solver_for(point["solver"], phi, SHAPE), measured(phi, readings))
        judged = slice(-N_JUDGED, None)
        errors = [frame_errors(frames[judged], truth[judged]) for frames in (restored, readings)]
        gains.append(mean_psnr(errors[0], truth[judged]) - mean_psnr(errors[1], truth[judged]))
    return {"k_over_m": float(np.mean(counts)) / m, "gain_db": float(np.mean(gains))}
