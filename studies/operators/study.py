"""The study `operators`: time of Phi, Psi and whole solvers, beside their lower bounds."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.numerics.programs import run as run_calls
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.bases.shifted_haar import ShiftedHaar
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.points import Function, compute

from .c import CFloor, c_compiler
from .page import NUMBA, NUMPY, C, write
from .peers import ADJOINT, ANALYSIS, FORWARD, PEERS, SYNTHESIS, Calls, missing_peers, peer_calls

#: One process at a time, so that what is timed has its core to itself.
TIMED_ON = "process:1"
SIDES, QUICK_SIDES = (20, 40, 64, 128), (20, 40)
BATCH = 16
SHRINK = "shrinking in shifted Haar"
OPERATORS = (FORWARD, ADJOINT, ANALYSIS, SYNTHESIS, SHRINK)
RATIO = 3
NOISE = NoiseModel.for_range(PAPER_F_MAX_N)
#: Duration of a window of calls that are timed together, microseconds. Chosen: shorter than a time
#: slice of the kernel, so that the median is of windows that were not interrupted.
WINDOW_US = 150.0
WINDOWS, QUICK_WINDOWS = 101, 21
#: Side of the matrices of the product that measures arithmetic speed.
PRODUCT_SIDE = 256


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Time what is not known yet, and write the page; see `command.Study`.

    `executor` is not used: all is timed on this host, one point at a time.
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
    common = {"seed": seed, "windows": QUICK_WINDOWS if quick else WINDOWS}
    n_frames = 100 if quick else 1000

    def rows_of(timed: Function, label: str, points: list[dict[str, Any]]) -> pd.DataFrame:
        found = compute(timed, points, out, TIMED_ON, label)
        return pd.DataFrame([row for figures in found for row in figures["rows"]])

    points = [{"side": side, "batch": BATCH, "peers": peers, **common} for side in sides]
    operators = rows_of(time_operators, "operators", points)
    points = [{"side": side, "n_frames": n_frames, **common} for side in sides if side > 20]
    solvers = rows_of(time_solvers, "solvers", points)
    write(out, operators, solvers, left_out, quick)


def has_numba() -> bool:
    """True if compiled loops can be timed."""
    return find_spec("numba") is not None


def median_us(function: Callable[[], object], windows: int) -> float:
    """Median time of a call over short windows of calls, microseconds."""
    function()
    calls = max(1, round(WINDOW_US / max(once_us(function), 0.05)))
    spans_us = []
    for _ in range(windows):
        begin_ns = time.perf_counter_ns()
        for _ in range(calls):
            function()
        spans_us.append((time.perf_counter_ns() - begin_ns) / 1e3 / calls)
    return float(np.median(spans_us))


def once_us(function: Callable[[], object]) -> float:
    """Time of one call, microseconds."""
    begin_ns = time.perf_counter_ns()
    function()
    return (time.perf_counter_ns() - begin_ns) / 1e3


def measured_speeds(n: int, windows: int) -> tuple[float, float]:
    """Best speeds of one core, measured.

    Returns
    -------
    flops_per_us : float
        Sums and products of a float32 matrix product, 256 x 256, in a microsecond.
    bytes_per_us : float
        Bytes read and written by a copy of n float32, in a microsecond.
    """
    a, b, c = (np.ones((PRODUCT_SIDE, PRODUCT_SIDE), dtype=np.float32) for _ in range(3))
    product_us = median_us(lambda: np.dot(a, b, c), windows)
    source, target = np.ones(n, dtype=np.float32), np.ones(n, dtype=np.float32)
    copy_us = median_us(lambda: np.copyto(target, source), windows)
    return 2 * PRODUCT_SIDE**3 / product_us, 8 * n / copy_us


def time_operators(point: dict[str, Any]) -> dict[str, Any]:
    """Time all operators of one size, in all ways, one after the other in one process.

    `point`: side of the skin, batch, seed, windows, peers.

    Returns
    -------
    dict
        rows: a dict for each operator and library, with alone_us and batch_us, the median a frame
        alone and in a batch; flop_us and memory_us, the lower bounds.
    """
    side, batch, windows = point["side"], point["batch"], point["windows"]
    n = side * side
    phi, basis = SbhePhi(n, n // RATIO, point["seed"]), HaarBasis(side, side)
    rng = np.random.default_rng(point["seed"])
    frames = rng.random((batch, side, side), dtype=np.float32)
    flops_per_us, bytes_per_us = measured_speeds(n, windows)
    libraries: dict[str, Calls] = {NUMPY: _numpy_calls(phi, basis, frames)}
    for peer in point["peers"]:
        libraries[peer] = peer_calls(peer, phi, basis, frames)
    rows = []
    for operator in OPERATORS:
        for library, calls in libraries.items():
            if operator not in calls:
                continue
            alone, together = calls[operator][1], calls[operator].get(batch)
            rows.append(
                {
                    "operator": operator,
                    "library": library,
                    "n": n,
                    "alone_us": round(median_us(alone, windows), 3),
                    "batch_us": together and round(median_us(together, windows) / batch, 3),
                    "flop_us": round(flops_of(operator, n, phi.block) / flops_per_us, 3),
                    "memory_us": round(bytes_of(operator, n) / bytes_per_us, 3),
                }
            )
    return {"rows": rows}


def flops_of(operator: str, n: int, block: int) -> float:
    """Least number of sums, differences and products of an operator."""
    if operator in (FORWARD, ADJOINT):
        return n * math.log2(block) + n / RATIO
    # 8 sums for 4 samples at each level, a quarter of which go on; then the scale of each.
    haar = 2 * n * 4 / 3
    if operator in (ANALYSIS, SYNTHESIS):
        return haar + n
    # Analysis and synthesis over three levels, and between them: square, compare, divide,
    # subtract, multiply.
    return 2 * 2 * n * (1 + 1 / 4 + 1 / 16) + 5 * n


def bytes_of(operator: str, n: int) -> float:
    """Bytes of input and output, which an operator has to read and write at least."""
    return 4 * (n + n / RATIO) if operator in (FORWARD, ADJOINT) else 8 * n


def _numpy_calls(phi: SbhePhi, basis: HaarBasis, frames: Floats) -> Calls:
    k, n = len(frames), phi.n
    x, thetas = frames.reshape(k, n), np.empty_like(frames)
    y, back = phi.forward(x), np.empty((k, n), np.float32)
    shifted = _shifted(basis)
    shrink = shifted.shrinking(np.zeros(shifted.size, np.float32), np.array(0.01, np.float32))
    return {
        FORWARD: {1: partial(phi.forward, x[0], y[0]), k: partial(phi.forward, x, y)},
        ADJOINT: {1: partial(phi.adjoint, y[0], back[0]), k: partial(phi.adjoint, y, back)},
        **{
            name: {1: partial(apply, frames[0], thetas[0]), k: partial(apply, frames, thetas)}
            for name, apply in ((ANALYSIS, basis.analysis), (SYNTHESIS, basis.synthesis))
        },
        SHRINK: {1: partial(run_calls, shrink)},
    }


def _shifted(basis: HaarBasis) -> ShiftedHaar:
    shape = (basis.n_rows, basis.n_cols)
    return ShiftedHaar(shape, np.arange(math.prod(shape)).reshape(shape), math.prod(shape))


def time_solvers(point: dict[str, Any]) -> dict[str, Any]:
    """Time whole frames, and single iterations beside the same in C.

    `point`: side of the skin, seed, windows, n_frames.

    Returns
    -------
    dict
        rows: a dict for each solver and way, with frame_ms, the median of frames, p99_ms, the
        99th percentile of the time that they had a core, the iterations of the median frame, and
        iteration_us; None where not measured.
    """
    side = point["side"]
    ways = [NUMPY, NUMBA] if has_numba() else [NUMPY]
    rows = []
    for name, settings in (("skin", {}), ("fista", {"iterations": 20})):
        rows += [_frames(name, way, point, settings) for way in ways]
        if c_compiler() is not None:
            floor = CFloor(side * side, levels=(side & -side).bit_length() - 1)
            iteration_us = round(median_us(getattr(floor, name), point["windows"]), 3)
            figures = dict.fromkeys(("frame_ms", "p99_ms", "iterations"))
            row = {"solver": name, "way": C, "n": side * side, **figures}
            rows.append({**row, "iteration_us": iteration_us})
    return {"rows": rows}


def _frames(name: str, way: str, point: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
    side = point["side"]
    phi = SbhePhi(side * side, side * side // RATIO, point["seed"])
    fast = "on" if way == NUMBA else "off"
    solver = make_solver(name, phi, make_basis("haar", side, side), fast=fast, **settings)
    rng = np.random.default_rng(point["seed"])
    spans_us, cpu_us, steps = [], [], []
    for frame in _sliding(side, point["n_frames"]):
        y = phi.forward(NOISE.apply(frame, rng).reshape(-1))
        begin_ns = time.thread_time_ns()
        spans_us.append(once_us(partial(solver.solve, y)))
        cpu_us.append((time.thread_time_ns() - begin_ns) / 1e3)
        steps.append(solver.n_steps)
    settled = slice(len(spans_us) // 4, None)
    return {
        **{"solver": name, "way": way, "n": side * side},
        "frame_ms": round(float(np.median(spans_us[settled])) / 1e3, 4),
        "p99_ms": round(float(np.percentile(cpu_us[settled], 99)) / 1e3, 4),
        "iterations": float(np.median(steps[settled])),
        "iteration_us": round(_iteration_us(solver, y, point["windows"]), 3),
    }


def _iteration_us(solver: Any, y: Floats, windows: int) -> float:
    """Median time of one step, over frames that are begun again and again."""
    spans_us: list[float] = []
    while len(spans_us) < windows:
        solver.setup(y)
        for _ in range(solver.n_steps):
            spans_us.append(once_us(solver.step))
        solver.finish()
    return float(np.median(spans_us))


def _sliding(side: int, n_frames: int) -> Iterator[Floats]:
    """A square that slides over the skin, a taxel in 50 frames; newtons."""
    for t in range(n_frames):
        frame = np.zeros((side, side), dtype=np.float32)
        first = side // 4 + t // 50
        frame[first : first + side // 5, side // 3 : side // 3 + side // 5] = 0.6
        yield frame
