"""The shipped nodes beside lean ones: processor time of a frame in each node, and its age."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from . import latency
from .lean import run_lean
from .stopwatch import PROCESSOR, WATCH

RATES_HZ = (1000, 300, 100)
QUICK_RATES_HZ = (1000, 100)
QUICK_SIZE = "64 x 64"
SECONDS = 3.0
SLICES = 3
"""Length of a slice, and number of slices of each; their medians count. Chosen: what else runs on a
host lasts for seconds, and so meets both kinds of nodes."""
WARM_UP = 0.25
"""Part of the first frames that is left out; chosen, for caches and memory."""
STEPS = 1
"""Steps of the solver in a frame, of both kinds: the pace of 1 kHz on a small host. Of more steps
the solver, which is the same, would hide the difference."""
NODES = ("sensor", "compressor", "reconstructor")


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """All rates, sizes, and with and without a monitor; quick: few of them, in short slices."""
    rates_hz = QUICK_RATES_HZ if quick else RATES_HZ
    sizes = (QUICK_SIZE,) if quick else tuple(latency.SCENES)
    common = {
        "preset": "skin",
        "depth": 0,
        "iterations": STEPS,
        "seed": seed,
    }
    common |= {"slices": SLICES, "seconds": SECONDS}
    return [
        {
            **common,
            "scene": latency.SCENES[size],
            "rate_hz": rate_hz,
            "monitor": monitor,
        }
        for monitor, size, rate_hz in product((False, True), sizes, rates_hz)
    ]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Run the shipped nodes and the lean ones in turn, on the same frames.

    `point`: scene, rate_hz, preset, depth, iterations, monitor, slices, seconds of each. Returns
    medians over the slices: of ours and lean, "KIND NODE_us", the processor time of a frame in each
    of `NODES` and, of ours, in the monitor; "KIND p50_ms" and "KIND p99_ms" of the age of a frame
    when it is reconstructed; "KIND lost"; "cpu ratio" and "p50 ratio", of the two in one slice.
    Raises StudyError if a node fails.
    """
    n_frames = round(point["seconds"] * point["rate_hz"])
    graph = {**point, "n_frames": n_frames}
    slices = []
    for _ in range(point["slices"]):
        ours = of_graph(latency.run_graph(graph), n_frames)
        slices.append(together(ours, of_lean(run_lean(graph))))
    return medians(slices)


def medians(slices: list[dict[str, float]]) -> dict[str, float]:
    """Median of each figure over the slices."""
    figures = {}
    for name in slices[0]:
        values = [of_slice[name] for of_slice in slices]
        figures[name] = round(float(np.median(values)), 4)
    return figures


def together(ours: dict[str, float], lean: dict[str, float]) -> dict[str, float]:
    """Figures of a slice of both kinds, and their ratios."""
    figures = {f"ours {name}": value for name, value in ours.items()}
    figures |= {f"lean {name}": value for name, value in lean.items()}
    # Without the monitor, for which there is no lean node.
    ours_us = sum(ours[f"{node}_us"] for node in NODES)
    lean_us = sum(lean[f"{node}_us"] for node in NODES)
    figures["cpu ratio"] = ours_us / lean_us
    figures["p50 ratio"] = ours["p50_ms"] / lean["p50_ms"]
    return figures


def of_graph(reports: dict[str, dict[str, Any]], n_frames: int) -> dict[str, float]:
    """Figures of a slice of the shipped nodes, by their reports."""
    figures = {}
    for node, report in reports.items():
        processor_ns = np.array(report[PROCESSOR], dtype=np.int64)
        figures[f"{node}_us"] = per_frame_us(processor_ns)
    # A note holds stamp, came, called and solved, in this order.
    host = np.array(reports["reconstructor"][WATCH], dtype=np.int64)
    figures |= ages_ms(host[:, 3])
    figures["lost"] = n_frames - len(host)
    return figures


def of_lean(notes: dict[str, npt.NDArray[np.int64]]) -> dict[str, float]:
    """Figures of a slice of the lean nodes, by their notes."""
    figures = {}
    for name, of_node in zip(NODES, notes.values(), strict=True):
        figures[f"{name}_us"] = per_frame_us(of_node[:, 2])
    sensor, *_, host = notes.values()
    figures |= ages_ms(host[:, 1])
    figures["lost"] = len(sensor) - len(host)
    return figures


def per_frame_us(processor_ns: npt.NDArray[np.int64]) -> float:
    """Mean processor time of a frame, us, of that which a process had used after each frame."""
    n_left_out = round(WARM_UP * len(processor_ns))
    counted = processor_ns[n_left_out:]
    used_us = float(counted[-1] - counted[0]) / 1e3
    return used_us / max(len(counted) - 1, 1)


def ages_ms(ages_ns: npt.NDArray[np.int64]) -> dict[str, float]:
    """Quantiles of the age of frames, ms, by the age of each in ns."""
    n_left_out = round(WARM_UP * len(ages_ns))
    counted = ages_ns[n_left_out:] / 1e6
    return {
        "p50_ms": float(np.quantile(counted, 0.5)),
        "p99_ms": float(np.quantile(counted, 0.99)),
    }
