"""Time and memory of the nodes of a body of many patches, wire form included, without sockets."""

from __future__ import annotations

import gc
import os
import time
from typing import Any

import numpy as np

from sparseskin.messages import Message, decode
from sparseskin.messages.wire import received, wire_bytes
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.registry import node_class

from .host import own_bytes

WARM_UP = 24
"""Frames before those that are timed: a patch is idle after 12, and solvers adapt; chosen."""


def time_body(point: dict[str, Any]) -> dict[str, Any]:
    """Processor time of edge and host for one frame of all patches of a lying body, at 1 kHz.

    `point`: patches; side in taxels; idle: part of them that nothing presses, which is not solved
    then; n_frames that are timed; seed. Returns edge_us, host_us: median time of a frame and patch
    (decoding, the node's step, encoding); solve_us, by the clock; iterations; bytes of the
    measurements of a frame; memory_mb of the reconstructor for one patch; unchanged: part of the
    frames not solved.
    """
    patches = point["patches"]
    n_frames = point["n_frames"]
    common = {"patch": "body", "patches": [f"p{k}" for k in range(patches)]}
    sensor = made_node("sensor", common | _source(point))
    edge = made_node("compressor", common)
    list(sensor.start())
    # The next frame is of the time when all have landed, then come frames each 1 ms.
    list(sensor.acquire(Tick(0, 0)))
    (skin,) = sensor.change(sensor.settings.changed({"rate_hz": 1000.0}))
    (phi,) = edge.step(skin)

    # Memory is that of the reconstructor alone: what is garbage is not counted.
    gc.collect()
    bytes_before = own_bytes(os.getpid())
    host = made_node("reconstructor", {**common, "skip_idle": point["idle"] > 0})
    list(host.step(skin))
    list(host.step(phi))

    edge_s: list[float] = []
    host_s: list[float] = []
    solve_s: list[float] = []
    n_unchanged = 0
    n_bytes = 0
    for k in range(WARM_UP + n_frames):
        (taxels, _) = sensor.acquire(Tick(1_000_000 * (k + 1), k + 1))
        (measured,) = timed_step(edge, wire_bytes(taxels), edge_s)
        (solved,) = timed_step(host, measured, host_s)
        if k >= WARM_UP:
            n_bytes = len(measured)
            forces: Any = decode(*received(solved))
            n_unchanged += sum(forces.unchanged)
            solve_s.append(1e-9 * sum(forces.solve_ns))

    added_bytes = own_bytes(os.getpid()) - bytes_before
    return {
        "edge_us": 1e6 * float(np.median(edge_s[WARM_UP:])) / patches,
        "host_us": 1e6 * float(np.median(host_s[WARM_UP:])) / patches,
        "solve_us": 1e6 * float(np.median(solve_s)) / patches,
        "iterations": max(forces.iterations),
        "bytes": float(n_bytes),
        "memory_mb": added_bytes / patches / 1e6,
        "unchanged": n_unchanged / patches / n_frames,
    }


def _source(point: dict[str, Any]) -> dict[str, Any]:
    """Settings of a sensor with a body that lies on its skin."""
    side = point["side"]
    return {
        "source": "scene:lying",
        "active": 1.0 - point["idle"],
        "seed": point["seed"],
        "simulated": {"n_rows": side, "n_cols": side},
        "rate_hz": 100.0,
    }


def made_node(type_name: str, values: dict[str, Any]) -> Any:
    """Make a node of a type with settings, without sockets."""
    cls = node_class(type_name)
    settings = cls.Settings.from_mapping(values)
    return cls(settings, Context(type_name, ManualClock(1)))


def timed_step(node: Any, buffer: bytes, spent: list[float]) -> list[bytes]:
    """Let a node process a message in its wire form; note the processor time."""
    begin_s = time.process_time()
    message: Message = decode(*received(buffer))
    sent = [wire_bytes(answer) for answer in node.step(message)]
    spent.append(time.process_time() - begin_s)
    return sent
