"""The time that other libraries, and the project's FISTA, take to the same objective."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from sparseskin.nodes.monitor.metrics import psnr_db

from .scene_frames import Floats, f_max_of, in_contact, shape_of
from .speed_peers import PEERS, Peer
from .speed_points import sequences
from .speed_problem import Bpdn

WITHIN = 1.01
#: Iterations that are tried until the objective is within 1 % of the minimum.
STEPS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 18, 22, 27, 33, 40, 50, 60, 75, 90, 120, 160, 220, 300)


def race(point: dict[str, Any]) -> dict[str, Any]:
    """Time one library to within 1 % of the minimum, each frame by itself from 0.

    How many iterations that takes is looked for first; the time is that of further calls with
    just as many, which have nothing to check: the shortest of three.

    Parameters
    ----------
    point : dict
        peer, scene, seed, short, ratio, lambda_n, n_frames.

    Returns
    -------
    dict
        median_ms, processor time a frame; iterations: their median; mean_db, worst_db; objective:
        the largest ratio to the minimum; nonzeros: median; n_frames.
    """
    problem = Bpdn(shape_of(point["scene"]), point["ratio"], point["seed"], point["lambda_n"])
    _, kind = PEERS[point["peer"]]
    spans_ms, counts, ratios, psnr = [], [], [], []
    for truth, taxels in _frames(point):
        y = problem.phi.forward(taxels.reshape(-1))
        best = problem.solution(y)
        lowest = problem.objective(best, y)
        peer = kind(problem, best)
        iterations = _needed(peer, y, WITHIN * lowest)
        solved, span_ms = _timed(peer, y, iterations)
        spans_ms.append(span_ms)
        theta = peer.theta(solved)
        counts.append(iterations)
        ratios.append(problem.objective(theta, y) / lowest)
        psnr.append(psnr_db(problem.image(theta) - truth, f_max_of(point["scene"])))
    return {
        "median_ms": round(float(np.median(spans_ms)), 4),
        "iterations": float(np.median(counts)),
        "mean_db": round(float(np.mean(psnr)), 3),
        "worst_db": round(float(np.min(psnr)), 3),
        "objective": round(max(ratios), 4),
        "n_frames": len(psnr),
    }


def _timed(peer: Peer, y: Floats, iterations: int) -> tuple[Any, float]:
    """What a peer finds, and the shortest of three processor times in ms."""
    spans_ns = []
    for _ in range(3):
        begin_ns = time.thread_time_ns()
        solved = peer.solve(y, iterations)
        spans_ns.append(time.thread_time_ns() - begin_ns)
    return solved, min(spans_ns) / 1e6


def _needed(peer: Peer, y: Floats, enough: float) -> int:
    """The fewest of `STEPS` that come low enough; the most, where none does."""
    if peer.stops_by_itself:
        peer.solve(y, STEPS[-1])
        return STEPS[-1]
    for iterations in STEPS:
        if peer.problem.objective(peer.theta(peer.solve(y, iterations)), y) <= enough:
            return iterations
    return STEPS[-1]


def _frames(point: dict[str, Any]) -> list[tuple[Floats, Floats]]:
    """Frames in contact, evenly spread over those of the scene."""
    f_max = f_max_of(point["scene"])
    pairs = [
        pair
        for truth, taxels in sequences(point["scene"], point["seed"], point["short"])
        for pair in zip(truth, taxels, strict=True)
        if in_contact(pair[0], f_max)
    ]
    chosen = np.linspace(0, len(pairs) - 1, min(point["n_frames"], len(pairs))).round()
    return [pairs[int(k)] for k in chosen]
