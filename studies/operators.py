"""The study `operators`: what Phi, Psi and whole solvers take, beside the least they could."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from .operators_c import c_compiler
from .operators_page import draw_operators, draw_solvers, write_operators_page
from .operators_peers import PEERS, missing_peers
from .operators_points import has_numba, time_operators, time_solvers
from .operators_timing import WINDOWS
from .points import compute

#: One process at a time, so that what is timed has its core to itself.
TIMED_ON = "process:1"
SIDES, QUICK_SIDES = (20, 40, 64, 128), (20, 40)
BATCH = 16


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Time what is not known yet, and write tables, charts and the page `operators.md`.

    Parameters
    ----------
    out : Path
        Folder to write to, which exists.
    quick : bool
        Two small sizes, and fewer windows and frames.
    seed : int
        Of Phi and of the frames.
    executor : str
        Not used: all is timed on this host, one point at a time.
    """
    absent = missing_peers()
    left_out = [f"{peer} is not installed (pip install 'sparseskin[peers]')" for peer in absent]
    if not has_numba():
        left_out.append("numba is not installed (pip install 'sparseskin[fast]')")
    if c_compiler() is None:
        left_out.append("no C compiler is installed")
    for line in left_out:
        print(f"left out: {line}", file=sys.stderr)
    sides = QUICK_SIDES if quick else SIDES
    peers = [peer for peer in PEERS if peer not in absent]
    common = {"seed": seed, "windows": 21 if quick else WINDOWS}
    rows: list[dict[str, Any]] = []
    points = [{"side": side, "batch": BATCH, "peers": peers, **common} for side in sides]
    for found in compute(time_operators, points, out, TIMED_ON, "operators"):
        rows += found["rows"]
    solver_rows: list[dict[str, Any]] = []
    points = [
        {"side": side, "n_frames": 100 if quick else 1000, **common} for side in sides if side > 20
    ]
    for found in compute(time_solvers, points, out, TIMED_ON, "solvers"):
        solver_rows += found["rows"]
    charts = [draw_operators(out, rows), draw_solvers(out, solver_rows)]
    write_operators_page(out, rows, solver_rows, charts, left_out, quick)
