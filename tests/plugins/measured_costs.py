r"""Measures the processor time of edge and host for every strategy: `costs.toml` on stdout.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
        python tests/plugins/measured_costs.py > plugins/design/costs.toml
"""

import os
import platform
from importlib.util import find_spec
from typing import Any

import numpy as np

from sparseskin.messages import Measurements, Message, SkinState, Taxels
from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.messages.wire import wire_bytes
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.plugins.design.models import FIGURES
from sparseskin.plugins.design.strategies import LARGER, SINGLE, STRATEGIES, Strategy
from sparseskin.studies.baselines.larger import LargerTaxels
from sparseskin.studies.presses import BODIES, Timing, press_frames
from sparseskin.studies.speed.bodies import WARM_UP, made_node, timed_step

SIZES = ((12, 32), (32, 32), (64, 64))
"""Skins that are timed: from a fingertip pad to a palm."""
DENSE = 0.2
"""Part of the taxels that a body presses: the most of those from which accuracy is stated."""
N_CALM = 24
N_PRESSED = 60
"""Frames of each body that are timed, after `WARM_UP` others: untouched ones, then pressed ones."""
N_REPEATS = 3
"""How often all is measured; the least time counts, as other programs on a core only add to it."""
HOW = f"""# python tests/plugins/measured_costs.py
# Processor time of a frame (time.process_time, which leaves out what other programs take), in
# microseconds: decoding, the node's step, encoding; median of the frames, least of {N_REPEATS}
# runs.
# edge_us: compressor, mean of the bodies. calm_us: reconstructor, nothing presses. dense_us:
# reconstructor, the body that takes longest of {", ".join(BODIES)},
# pressing {DENSE:.0%} of the taxels for {N_PRESSED} frames, noise of the paper."""


def measure(
    strategy: Strategy, shape: tuple[int, int], seed: int = 0
) -> dict[str, float]:
    """`FIGURES` of a strategy on a skin that each of `BODIES` presses, microseconds."""
    runs = [
        [_measure(strategy, shape, body, seed) for body in BODIES]
        for _ in range(N_REPEATS)
    ]
    edge, calm, pressed = np.moveaxis(np.array(runs), -1, 0)  # each: repeats x bodies
    of_run = (edge.mean(axis=1), calm.min(axis=1), pressed.max(axis=1))
    return {
        key: round(float(us.min()), 1) for key, us in zip(FIGURES, of_run, strict=True)
    }


def _measure(
    strategy: Strategy, shape: tuple[int, int], body: str, seed: int
) -> tuple[float, float, float]:
    """Median processor time under one body, microseconds: edge pressed, host untouched, pressed."""
    noise = NoiseModel.for_range(PAPER_F_MAX_N)
    host: Any = (
        _Decoder() if strategy.sums == SINGLE else made_node("reconstructor", {})
    )
    phi = strategy.phi
    if phi == LARGER:
        # The edge of a skin of fewer taxels, all of them read, and the interpolation.
        host = _Interpolator(
            np.ones(shape, dtype=np.bool_), strategy.m(shape[0] * shape[1])
        )
        shape = (shape[0] // 2, shape[1] // 2)
        phi = "full"
    skin = Skin(*shape, noise.f_max, "N", 0.004)
    settings: dict[str, Any] = {"phi": phi, "seed": seed, "rows": strategy.rows}
    if phi != "full":
        settings["m"] = strategy.m(skin.n_taxels, skin.n_rows)
    edge = made_node("compressor", settings)
    stated: dict[str, Any] = {
        "stamp_ns": 0,
        "patch": "skin",
        "source": "presses",
        "seed": seed,
    }
    stated |= {"rate_hz": 1000.0, "has_truth": False, **vars(skin)}
    state = SkinState(**stated, sigma_mid=noise.sigma_mid, sigma_end=noise.sigma_end)
    (phi_state,) = edge.step(state)
    for message in (state, phi_state):
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
        timed_step(
            host, timed_step(edge, wire_bytes(taxels), spent["edge"])[0], spent["host"]
        )

    def median_us(station: str, first: int, last: int | None) -> float:
        return 1e6 * float(np.median(spent[station][first:last]))

    pressed = median_us("host", before, None)
    return median_us("edge", before, None), median_us("host", WARM_UP, before), pressed


class _Decoder:
    """A host of readings that need no reconstruction."""

    def step(self, message: Message) -> list[Message]:
        return [message]


class _Interpolator:
    """A host of larger taxels, which publishes forces of small ones."""

    def __init__(self, mask: Any, m: int) -> None:
        self._larger = LargerTaxels(mask, m)

    def step(self, message: Message) -> list[Message]:
        """Forces of a frame; other messages as they are."""
        if not isinstance(message, Measurements):
            return [message]
        forces = self._larger.spread(np.asarray(message.y[0]))
        return [Taxels(stamp_ns=message.stamp_ns, patch=message.patch, forces=forces)]


def main() -> None:
    fast = "numba" if find_spec("numba") else "numpy alone"
    load = f"load average {os.getloadavg()[0]:.1f} at the begin"
    print(HOW)
    print(
        f'conditions = "one core of {os.cpu_count()}, {platform.machine()}, {fast}, {load}"'
    )
    for shape in SIZES:
        print(f"\n[cost.{shape[0] * shape[1]}]")
        for name, strategy in STRATEGIES.items():
            found = measure(strategy, shape)
            figures = ", ".join(f"{key} = {us}" for key, us in found.items())
            print(f'"{name}" = {{ {figures} }}', flush=True)


if __name__ == "__main__":
    main()
