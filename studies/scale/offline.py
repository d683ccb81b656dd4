"""Throughput of recorded frames of a body: one core, two cores, and workers of a Dask cluster."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import pandas as pd

from sparseskin.nodes.node import Tick
from sparseskin.nodes.tasks.executors import make_executor
from sparseskin.studies.report import markdown

from .nodes import made_node

WAYS = {
    "one core": "serial",
    "two cores": "process:2",
    "Dask, 1 worker": "dask:local:1",
    "Dask, 2 workers": "dask:local:2",
}
"""Executors that are compared, by their names in the table."""
FLOAT_BYTES = 4
N_TASKS = 4
"""Tasks of a measurement: two for each of two workers. Chosen."""

Point = dict[str, Any]


def reconstruct_part(point: Point) -> int:
    """Compress and reconstruct consecutive frames of a lying body; a task of an executor.

    `point`: patches, side, n_frames, seed. Returns the number of frames.
    """
    names = [f"p{k}" for k in range(point["patches"])]
    common = {"patch": "body", "patches": names}
    sensor = made_node(
        "sensor_batch",
        {
            **common,
            "source": "scene:lying",
            "seed": point["seed"],
            "n_rows": point["side"],
            "n_cols": point["side"],
            "rate_hz": 100.0,
        },
    )
    edge, host = made_node("compressor_batch", common), made_node("reconstructor_batch", common)
    (skin,) = sensor.start()
    (phi,) = edge.step(skin)
    for state in (skin, phi):
        list(host.step(state))
    for k in range(point["n_frames"]):
        (taxels,) = _of_frame(sensor, k)
        (measured,) = edge.step(taxels)
        (_,) = host.step(measured)
    return int(point["n_frames"])


def _of_frame(sensor: Any, k: int) -> list[Any]:
    """The taxels of a frame, without their truth."""
    return [m for m in sensor.acquire(Tick(10_000_000 * (k + 1), k)) if m.schema == "taxels_batch"]


def throughput(
    patches: Sequence[int], n_frames: Sequence[int], side: int, seed: int
) -> list[Point]:
    """Frames and bytes a second of a body by its number of patches and by executor.

    Wall-clock time of `N_TASKS` tasks of `n_frames` frames each, from the first submission to the
    last result, after each worker has done a task of the smallest body: imports and compiled loops
    are not counted, set-up of the nodes, frames of the sensor and the executor's own work are.
    """
    found = []
    for name, spec in WAYS.items():
        with make_executor(spec) as executor:
            warm = {"patches": 1, "side": side, "n_frames": 2, "seed": seed}
            for future in [executor.submit(reconstruct_part, warm) for _ in range(2 * N_TASKS)]:
                future.result()
            for n_patches, n in zip(patches, n_frames, strict=True):
                point = {"patches": n_patches, "side": side, "n_frames": n}
                begin_s = time.perf_counter()
                futures = [
                    executor.submit(reconstruct_part, {**point, "seed": seed + k})
                    for k in range(N_TASKS)
                ]
                done = sum(future.result() for future in futures)
                rate_hz = done / (time.perf_counter() - begin_s)
                n_bytes = FLOAT_BYTES * n_patches * side**2
                found.append(
                    {
                        "way": name,
                        "taxels": n_patches * side**2,
                        "frames_s": rate_hz,
                        "bytes_s": rate_hz * n_bytes,
                    }
                )
    return found


def throughput_table(found: Sequence[Point]) -> str:
    """Frames and MB a second by taxels, one column an executor."""
    rows = []
    for taxels in sorted({one["taxels"] for one in found}):
        row: dict[str, Any] = {"taxels": f"{taxels:,}"}
        for name in WAYS:
            for one in found:
                if (one["way"], one["taxels"]) == (name, taxels):
                    row[name] = f"{one['frames_s']:.3g} frames/s, {one['bytes_s'] / 1e6:.3g} MB/s"
        rows.append(row)
    return markdown(pd.DataFrame(rows))
