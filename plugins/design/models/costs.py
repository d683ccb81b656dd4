"""Processor time of edge and host for a frame: measured once, and stored in `costs.toml`."""

from __future__ import annotations

import functools
import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

LARGEST = 4096
"""Taxels of the largest patch that is timed. A larger skin is taken as several patches of so many:
each is reconstructed by itself."""
FIGURES = ("edge_us", "calm_us", "dense_us")
"""Figures of a strategy on a skin: fields of `Cost`, in microseconds."""
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
    """Return the stored cost of a frame of one patch. Between the stored sizes, log(time) is linear
    in log(taxels); below the smallest, the cost is that of the smallest, and beyond `LARGEST` in
    proportion to the taxels.
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
