"""Processor time that each node of a graph takes up to its first frame."""

from __future__ import annotations

import tempfile
from typing import Any

import numpy as np

from . import latency
from .processes import NODES
from .stopwatch import PROCESSOR

SCENE = "drag_wrench_64"
STARTS = 3
N_FRAMES = 20
RATE_HZ = 100.0
STORED = {True: "stored", False: "none"}
"""Whether the bytecode of modules is stored, in words."""


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """One graph, with bytecode that is stored and without; if quick, the first alone."""
    common: dict[str, Any] = {
        "scene": SCENE,
        "preset": "skin",
        "depth": 1,
        "seed": seed,
    }
    common["source"] = f"scene:{SCENE}"
    common |= {
        "monitor": True,
        "rate_hz": RATE_HZ,
        "n_frames": N_FRAMES,
    }
    point = {**common, "starts": 1 if quick else STARTS}
    stored = [True] if quick else [True, False]
    return [{**point, "bytecode": bytecode} for bytecode in stored]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Start the graph of a point some times.

    `point`: bytecode, starts, and those of `latency.run_graph`. Returns "NODE_s", the least
    processor time, user and system, that the process of a node had used after its first frame.
    Raises StudyError if a node fails.
    """
    used_s: dict[str, list[float]] = {node: [] for node in NODES}
    with tempfile.TemporaryDirectory(prefix="sparseskin-speed-") as folder:
        variables = {"PYTHONDONTWRITEBYTECODE": ""}
        if not point["bytecode"]:
            # Neither found nor stored.
            variables["PYTHONDONTWRITEBYTECODE"] = "1"
            variables["PYTHONPYCACHEPREFIX"] = folder
        for _ in range(point["starts"]):
            for node, report in latency.run_graph(point, variables).items():
                used_s[node].append(report[PROCESSOR][0] / 1e9)
    return {f"{node}_s": float(np.min(each)) for node, each in used_s.items()}
