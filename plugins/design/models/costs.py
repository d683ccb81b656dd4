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
from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.presses import BODIES, Timing, press_frames
from sparseskin.plugins.design.strategies import SINGLE, STRATEGIES, Strategy
from sparseskin.studies.speed.bodies import WARM_UP, made_node, timed_step

SIZES = ((12, 32), (32, 32), (64, 64))
"""Skins that are timed: from a fingertip pad to a palm."""
N_CALM, N_PRESSED = 24, 60
"""Frames of each body that are timed, after `WARM_UP` others: untouched ones, then pressed ones."""
DENSE = 0.2
"""Part of the taxels that a body presses: the most of those from which accuracy is stated."""
N_REPEATS = 3
"""How often all is measured; the least time counts, as other programs on a core only add to it."""
LARGEST = 4096
"""Taxels of the largest patch that is timed. A larger skin is taken as several patches of so many:
each is reconstructed by itself."""
FIGURES = ("edge_us", "calm_us", "dense_us")
"""Figures of a strategy on a skin: fields of `Cost`, in microseconds."""
COMMAND = "sparseskin design --measure-costs"
HOW = (
    "Processor time of a frame (time.process_time, which leaves out what other programs take), in",
    "microseconds: decoding, the node's step, encoding; median over the frames, least of "
    f"{N_REPEATS} runs.",
    "edge_us: compressor, mean of the bodies. calm_us: reconstructor, nothing presses. dense_us:",
    f"reconstructor, the body that takes longest of {', '.join(BODIES)},",
    f"pressing {DENSE:.0%} of the taxels for {N_PRESSED} frames, noise of the paper.",
)
"""Lines of `costs.toml` that state how it was measured."""
HOP_S = 0.28e-3
"""Time of a frame from one process to the next, seconds: half of the column "wires" of
`sparseskin study speed`, 64 x 64 taxels at 1 kHz, every frame reconstructed."""


@dataclass(frozen=True)
class Cost:
    """Processor time of a frame, seconds: of the compressor on Linux, and of the reconstructor for
    an untouched frame and for one of a dense press.
    """

    edge_s: float
    calm_s: float
    dense_s: float


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
    for key in FIGURES:
        us = [float(table[str(size)][strategy][key]) for size in sizes]
        log_us = np.interp(math.log(n_taxels), np.log(sizes), np.log(us))
        found.append(math.exp(float(log_us)) * max(1.0, n_taxels / sizes[-1]) * 1e-6)
    return Cost(*found)


@functools.cache
def stored() -> dict[str, Any]:
    """The stored table: conditions, and `FIGURES` by taxels and strategy."""
    return tomllib.loads((Path(__file__).parent / "costs.toml").read_text(encoding="utf-8"))


def measure(strategy: Strategy, shape: tuple[int, int], seed: int = 0) -> dict[str, float]:
    """Time the nodes compressor and reconstructor on a skin that each of `BODIES` presses.

    Returns
    -------
    dict of str to float
        `FIGURES`: processor time of a frame, microseconds: decoding, the node's step, encoding;
        median over the frames. edge_us: mean of the bodies, pressing; calm_us: of untouched frames,
        the least of the bodies; dense_us: of the body whose frames take longest. Each is the least
        of `N_REPEATS`. Single taxels are used as they are read: their host decodes, and solves
        nothing.
    """
    runs = [[_measure(strategy, shape, body, seed) for body in BODIES] for _ in range(N_REPEATS)]
    edge, calm, pressed = np.moveaxis(np.array(runs), -1, 0)  # each: repeats x bodies
    of_run = (edge.mean(axis=1), calm.min(axis=1), pressed.max(axis=1))
    return {key: round(float(us.min()), 1) for key, us in zip(FIGURES, of_run, strict=True)}


def _measure(
    strategy: Strategy, shape: tuple[int, int], body: str, seed: int
) -> tuple[float, float, float]:
    """Median processor time under one body, microseconds: of the edge in pressed frames, and of the
    host in untouched and in pressed ones.
    """
    noise = NoiseModel.for_range(PAPER_F_MAX_N)
    skin = Skin(*shape, noise.f_max, "N", 0.004)
    settings: dict[str, Any] = {"phi": strategy.phi, "seed": seed, "rows": strategy.rows}
    if strategy.phi != "full":
        settings["m"] = strategy.m(skin.n_taxels, skin.n_rows)
    edge = made_node("compressor", settings)
    host = _Decoder() if strategy.sums == SINGLE else made_node("reconstructor", {})
    stated: dict[str, Any] = {"stamp_ns": 0, "patch": "skin", "source": "presses", "seed": seed}
    stated |= {"rate_hz": 1000.0, "has_truth": False, **vars(skin)}
    state = SkinState(**stated, sigma_mid=noise.sigma_mid, sigma_end=noise.sigma_end)
    (phi,) = edge.step(state)
    for message in (state, phi):
        list(host.step(message))
    spent: dict[str, list[float]] = {"edge": [], "host": []}
    before = WARM_UP + N_CALM
    frames = press_frames(
        *(body, shape, before + N_PRESSED, seed),
        active=DENSE,
        noise=noise,
        timing=Timing(before),
    )
    for k, (_, forces) in enumerate(frames):
        taxels = Taxels(stamp_ns=1_000_000 * (k + 1), patch="skin", forces=forces)
        measured = timed_step(edge, encode(taxels), spent["edge"])
        timed_step(host, measured[0], spent["host"])

    def median_us(station: str, first: int, last: int | None) -> float:
        return 1e6 * float(np.median(spent[station][first:last]))

    pressed = median_us("host", before, None)
    return median_us("edge", before, None), median_us("host", WARM_UP, before), pressed


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
    lines = [f"# {COMMAND}"]
    lines += [f"# {line}" for line in HOW]
    lines += [f'conditions = "{conditions}"']
    for size, strategies in found.items():
        lines += ["", f"[cost.{size}]"]
        lines += [
            f"{name} = {{ {', '.join(f'{key} = {one[key]}' for key in FIGURES)} }}"
            for name, one in strategies.items()
        ]
    return "\n".join([*lines, ""])
