"""Which points `speed-accuracy` computes: every solver, basis and Phi, but not all combinations.

- Every solver, with its own settings and with those of each preset: iterations swept at M = N/3,
  and M swept at its own iterations; Haar, SBHE.
- Every solver on Phi "full": all taxels sent, and denoised.
- Every basis and every Phi, with the paper's solver and M swept: on fewer frames, as a dense Phi
  is slow.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

from sparseskin.nodes.compressor.phi import KINDS
from sparseskin.nodes.compressor.rotation import ROTATING
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.lookup import find_class
from sparseskin.nodes.reconstructor.basis import BASES
from sparseskin.nodes.reconstructor.presets import PRESETS
from sparseskin.nodes.reconstructor.solver import SOLVERS

from .solvers import SUM_SOLVERS

SCENES = (
    *("lift_box_40", "lift_wrench_40", "drag_wrench_40", "path_40"),
    *("lift_box_64", "drag_wrench_64"),
)
QUICK_SCENES = ("drag_wrench_40", "lift_box_64")
ITERATIONS = (3, 5, 10, 20, 30)
QUICK_ITERATIONS = (5, 20)
RATIOS = (2, 3, 4, 8, 16)
QUICK_RATIOS = (3, 8)
#: Every Phi but the one that no solver of sums inverts.
SUM_KINDS = tuple(kind for kind in KINDS if kind != "acts")
#: With every basis and every Phi.
PARTS_RATIOS = (3, 4, 8)
PAPER_LABEL = "fista, preset paper"
CENTRE_RATIO = 3
#: The paper's lambda that serves it best: a second yardstick.
TUNED_LAMBDA_N = 0.0125
VARIED = {
    "skin, rotating rows": {**PRESETS["skin"], "rows": ROTATING},
    "fista, tuned": {**PRESETS["paper"], "lambda_n": TUNED_LAMBDA_N},
}
COMPILED = {"skin, compiled": {**PRESETS["skin"], "fast": "on"}}

Point = dict[str, Any]


def variants() -> dict[str, dict[str, Any]]:
    """Solvers by the label they are shown with: solver, basis and settings.

    Each preset, `skin` with rotating rows and (with numba) in compiled loops, the tuned FISTA,
    and each solver that has no preset with its own defaults.
    """
    found = {f"{preset['solver']}, preset {name}": dict(preset) for name, preset in PRESETS.items()}
    varied = VARIED | (COMPILED if find_spec("numba") else {})
    found |= {label: dict(chosen) for label, chosen in varied.items()}
    covered = {chosen["solver"] for chosen in found.values()}
    found |= {
        name: {"solver": name, "basis": "haar"} for name in SUM_SOLVERS if name not in covered
    }
    return found


def takes_iterations(solver: str) -> bool:
    """Whether a solver lets itself be told a number of iterations."""
    return (
        "iterations"
        in inspect.signature(find_class("solver", solver, SOLVERS, SolverError)).parameters
    )


def design(quick: bool, seed: int) -> list[Point]:
    """All points of the study, scene by scene, so that a worker reads a scene's frames once."""
    points: list[Point] = []
    for scene in QUICK_SCENES if quick else SCENES:
        for way in _ways(quick):
            point = {"scene": scene, "seed": seed, **way}
            if point not in points:
                points.append(point)
    return points


def _ways(quick: bool) -> Iterator[Point]:
    ratios = QUICK_RATIOS if quick else RATIOS
    for label, chosen in variants().items():
        way = {"label": label, "short": quick, "phi": "sbhe", **chosen}
        if takes_iterations(chosen["solver"]):
            for iterations in QUICK_ITERATIONS if quick else ITERATIONS:
                yield {**way, "ratio": CENTRE_RATIO, "iterations": iterations}
        for ratio in ratios:
            yield {**way, "ratio": ratio}
        if "rows" not in chosen:
            yield {**way, "phi": "full", "ratio": 1}
    paper = {"label": PAPER_LABEL, "short": True, "phi": "sbhe", **PRESETS["paper"]}
    for ratio in QUICK_RATIOS if quick else PARTS_RATIOS:
        for basis in BASES:
            yield {**paper, "basis": basis, "ratio": ratio}
        for phi in SUM_KINDS:
            yield {**paper, "phi": phi, "ratio": 1 if phi == "full" else ratio}
