"""Set-up, memory and time of a frame of each kind of Phi, beside the default one, in turn."""

from __future__ import annotations

import gc
import os
import time
from typing import Any, NamedTuple

import numpy as np

from sparseskin.messages import SkinState, Taxels, decode
from sparseskin.messages.wire import received, wire_bytes
from sparseskin.nodes.compressor.phi.gaussian import N_MAX
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.presses import noisy_skin, press_frames

from .bodies import made_node, timed_step
from .host import own_bytes

DEFAULT = ("sbhe", 3)
KINDS = (DEFAULT, ("full", 1), ("subsample", 3), ("gaussian", 3))
"""Kind, and number of taxels for each measurement."""
SIDES = (64, 96)
QUICK_SIDES = (32,)
N_FRAMES = 80
WARM_UP = 40
"""First frames, left out: the press grows, and the solver adapts."""
PERIOD_NS = 1_000_000


class Pair(NamedTuple):
    """Compressor and reconstructor of a kind, what they took to set up, and processor times of
    their frames, s.
    """

    edge: Any
    host: Any
    set_up_s: float
    memory_mb: float
    edge_s: list[float]
    host_s: list[float]

    def us(self, times_s: list[float]) -> float:
        """Median of a frame, us."""
        return 1e6 * float(np.median(times_s[WARM_UP:]))


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """All kinds on skins of some sides."""
    sides = QUICK_SIDES if quick else SIDES
    return [
        {
            "kind": kind,
            "ratio": ratio,
            "side": side,
            "seed": seed,
        }
        for side in sides
        for kind, ratio in KINDS
        if kind != "gaussian" or side**2 <= N_MAX
    ]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Reconstruct the frames of a plate that slides over the skin by a kind of Phi and by the
    default one, in turn.

    `point`: kind, ratio, side in taxels, seed. Returns, of edge and host together, set_up_s,
    processor time to make Phi and solver; memory_mb, what they hold then;
    edge_us and host_us, median processor time of a frame, wire form included; error, RMS in newtons
    of the frames after `WARM_UP`; and "ratio to default" of the time of a frame.
    """
    noise = NoiseModel()
    side = point["side"]
    # Without a rate no frame has less time than the iterations of the default need.
    state = noisy_skin(side, source="plate", pitch_m=0.005, seed=point["seed"])
    default = _set_up(*DEFAULT, state)
    pair = _set_up(point["kind"], point["ratio"], state)
    squares = []
    frames = press_frames(
        "plate", (side, side), N_FRAMES, point["seed"], speed=0.02, noise=noise
    )
    for k, (truth, forces) in enumerate(frames):
        _reconstruct(default, forces, k)
        solved = _reconstruct(pair, forces, k)
        if k >= WARM_UP:
            squares.append(float(np.mean((solved - truth) ** 2)))
    frame_us = pair.us(pair.edge_s) + pair.us(pair.host_s)
    default_us = default.us(default.edge_s) + default.us(default.host_s)
    return {
        "set_up_s": pair.set_up_s,
        "memory_mb": pair.memory_mb,
        "edge_us": pair.us(pair.edge_s),
        "host_us": pair.us(pair.host_s),
        "error": float(np.sqrt(np.mean(squares))),
        "ratio to default": frame_us / default_us,
    }


def _set_up(kind: str, ratio: float, state: SkinState) -> Pair:
    """Make compressor and reconstructor of a kind, for a skin."""
    settings: dict[str, Any] = {"phi": kind}
    # One that reads all taxels has no other ratio.
    if ratio > 1:
        settings["ratio"] = ratio
    gc.collect()
    bytes_before = own_bytes(os.getpid())
    begin_s = time.process_time()
    edge = made_node("compressor", settings)
    host = made_node("reconstructor", {})
    for message in (state, *edge.step(state)):
        list(host.step(message))
    set_up_s = time.process_time() - begin_s
    memory_mb = (own_bytes(os.getpid()) - bytes_before) / 1e6
    return Pair(edge, host, set_up_s, memory_mb, edge_s=[], host_s=[])


def _reconstruct(pair: Pair, forces: Floats, k: int) -> Floats:
    """Compress and reconstruct frame k; return the forces."""
    taxels = Taxels(
        stamp_ns=(k + 1) * PERIOD_NS,
        patch="skin",
        forces=forces,
    )
    (measured,) = timed_step(pair.edge, wire_bytes(taxels), pair.edge_s)
    solved, *_ = timed_step(pair.host, measured, pair.host_s)
    message: Any = decode(*received(solved))
    reconstructed: Floats = message.forces[0]
    return reconstructed
