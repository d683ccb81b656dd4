"""Processor time of edge and host for a frame: measured once and stored, or measured anew."""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages import Message, SkinState, Taxels, encode
from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.presses import BODIES, N_BEFORE, press_frames
from sparseskin.studies.design.strategies import SINGLE, STRATEGIES, Strategy
from sparseskin.studies.scale.nodes import made_node, timed_step

SIZES = ((12, 32), (32, 32), (64, 64))
"""Skins that are timed: from a fingertip pad to a palm."""
N_FRAMES = 60
"""Frames of each body that are timed, after `N_BEFORE` untouched ones."""
LARGEST = 4096
"""Taxels of the largest patch that is timed. A larger skin is taken as several patches of so many:
each is reconstructed by itself."""
COMMAND = "sparseskin design --measure-costs"
HOP_S = 0.28e-3
"""Time of a frame from one process to the next, seconds: half of the column "wires" of
`sparseskin study latency`, 64 x 64 taxels at 1 kHz, every frame reconstructed."""
LATENCY_COMMAND = "sparseskin study latency"


@dataclass(frozen=True)
class Cost:
    """Processor time of a frame, seconds: of the compressor on Linux, and of the reconstructor."""

    edge_s: float
    host_s: float


def cost(strategy: str, n_taxels: int) -> Cost:
    """Return the stored cost of a frame of one patch.

    Between the stored sizes, log(time) is linear in log(taxels); below the smallest, the cost is
    that of the smallest, and beyond `LARGEST` in proportion to the taxels.

    Parameters
    ----------
    strategy : str
        A name in `STRATEGIES`.
    n_taxels : int
    """
    table = stored()["cost"]
    sizes = sorted(int(size) for size in table)
    found = []
    for key in ("edge_us", "host_us"):
        us = [float(table[str(size)][strategy][key]) for size in sizes]
        log_us = np.interp(math.log(n_taxels), np.log(sizes), np.log(us))
        found.append(math.exp(float(log_us)) * max(1.0, n_taxels / sizes[-1]) * 1e-6)
    return Cost(*found)


@functools.cache
def stored() -> dict[str, Any]:
    """The stored table: conditions, and edge_us and host_us by taxels and strategy."""
    return tomllib.loads((Path(__file__).parent / "costs.toml").read_text(encoding="utf-8"))


def measure(strategy: Strategy, shape: tuple[int, int], seed: int = 0) -> dict[str, float]:
    """Time the nodes compressor and reconstructor on a skin that each of `BODIES` presses.

    Returns
    -------
    dict of str to float
        edge_us, host_us: processor time of a frame, microseconds: decoding, the node's step,
        encoding; mean over the bodies of the median over the frames. Single taxels are used as they
        are read: their host decodes, and solves nothing.
    """
    found = [_measure(strategy, shape, body, seed) for body in BODIES]
    return {
        f"{station}_us": round(float(np.mean([one[station] for one in found])), 1)
        for station in found[0]
    }


def _measure(strategy: Strategy, shape: tuple[int, int], body: str, seed: int) -> dict[str, float]:
    """Median processor time of edge and host under one body, microseconds."""
    n_rows, n_cols = shape
    settings: dict[str, Any] = {"phi": strategy.phi, "seed": seed, "rows": strategy.rows}
    if strategy.phi != "full":
        settings["m"] = strategy.m(n_rows * n_cols, n_rows)
    edge = made_node("compressor", settings)
    host = _Decoder() if strategy.sums == SINGLE else made_node("reconstructor", {})
    noise = NoiseModel.for_range(PAPER_F_MAX_N)
    skin = SkinState(
        stamp_ns=0,
        patch="skin",
        n_rows=n_rows,
        n_cols=n_cols,
        f_max=noise.f_max,
        unit="N",
        pitch_m=0.004,
        mask=None,
        source="presses",
        seed=seed,
        rate_hz=1000.0,
        has_truth=False,
        sigma_mid=noise.sigma_mid,
        sigma_end=noise.sigma_end,
    )
    (phi,) = edge.step(skin)
    for state in (skin, phi):
        list(host.step(state))
    spent: dict[str, list[float]] = {"edge": [], "host": []}
    frames = press_frames(body, shape, N_BEFORE + N_FRAMES, seed, noise=noise)
    for k, (_, forces) in enumerate(frames):
        message: Message = Taxels(stamp_ns=1_000_000 * (k + 1), patch="skin", forces=forces)
        measured = timed_step(edge, encode(message), spent["edge"])
        timed_step(host, measured[0], spent["host"])
    return {name: 1e6 * float(np.median(times[N_BEFORE:])) for name, times in spent.items()}


class _Decoder:
    """A host of readings that need no reconstruction."""

    def step(self, message: Message) -> list[Message]:
        return [message]


def measure_all(progress: Any = None) -> dict[str, dict[str, dict[str, float]]]:
    """Measure every strategy for every size; the result is what `as_toml` writes."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for shape in SIZES:
        of_size = found.setdefault(str(shape[0] * shape[1]), {})
        for name, strategy in STRATEGIES.items():
            of_size[name] = measure(strategy, shape)
            if progress is not None:
                progress(shape, name, of_size[name])
    return found


def as_toml(found: Mapping[str, Mapping[str, Mapping[str, float]]], conditions: str) -> str:
    """Text of `costs.toml`."""
    lines = [f"# {COMMAND}", f'conditions = "{conditions}"']
    for size, strategies in found.items():
        lines += ["", f"[cost.{size}]"]
        lines += [
            f"{name} = {{ edge_us = {one['edge_us']}, host_us = {one['host_us']} }}"
            for name, one in strategies.items()
        ]
    return "\n".join([*lines, ""])
