"""What is timed for `operators`: each operator, and whole solvers, at one size."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import run
from sparseskin.nodes.compressor.sbhe import SbhePhi
from sparseskin.nodes.fast import ready
from sparseskin.nodes.reconstructor.basis import make_basis
from sparseskin.nodes.reconstructor.haar import HaarBasis
from sparseskin.nodes.reconstructor.shifted_haar import ShiftedHaar
from sparseskin.nodes.reconstructor.solver import make_solver
from sparseskin.nodes.sensor.noise import NoiseModel

from .operators_c import CFloor, c_compiler
from .operators_peers import ADJOINT, ANALYSIS, FORWARD, SYNTHESIS, Calls, peer_calls
from .operators_timing import measured_machine, median_us, once_us

Floats = npt.NDArray[np.float32]

SHRINK = "shrinking in shifted Haar"
OPERATORS = (FORWARD, ADJOINT, ANALYSIS, SYNTHESIS, SHRINK)
NUMPY, NUMBA, C = "numpy", "numba", "C"
RATIO = 3
NOISE = NoiseModel.for_range(2.5)


def has_numba() -> bool:
    """Whether compiled loops can be timed."""
    return find_spec("numba") is not None


def time_operators(point: dict[str, Any]) -> dict[str, Any]:
    """Time all operators of one size, in all ways, one after the other in one process.

    Parameters
    ----------
    point : dict
        side of the skin, batch, seed, windows, peers.

    Returns
    -------
    dict
        rows: a dict for each operator and library, with alone_us and batch_us, the median a frame
        alone and in a batch; flop_us and memory_us, the least there can be.
    """
    side, batch, windows = point["side"], point["batch"], point["windows"]
    n = side * side
    phi, basis = SbhePhi(n, n // RATIO, point["seed"]), HaarBasis(side, side)
    rng = np.random.default_rng(point["seed"])
    frames = rng.random((batch, side, side), dtype=np.float32)
    machine = measured_machine(n, windows)
    libraries: dict[str, Calls] = {NUMPY: _numpy_calls(phi, basis, frames)}
    if has_numba():
        libraries[NUMBA] = _numba_calls(phi, basis, frames)
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
                    "flop_us": round(machine.flop_floor_us(flops_of(operator, n, phi.block)), 3),
                    "memory_us": round(machine.memory_floor_us(bytes_of(operator, n)), 3),
                }
            )
    return {"rows": rows}


def flops_of(operator: str, n: int, block: int) -> float:
    """Sums, differences and products that an operator needs at least."""
    if operator in (FORWARD, ADJOINT):
        return n * math.log2(block) + n / RATIO
    # 8 sums for 4 samples at each level, a quarter of which go on; then the scale of each.
    haar = 2 * n * 4 / 3
    if operator in (ANALYSIS, SYNTHESIS):
        return haar + n
    # There and back over three levels; square, compare, divide, subtract and multiply between.
    return 2 * 2 * n * (1 + 1 / 4 + 1 / 16) + 5 * n


def bytes_of(operator: str, n: int) -> float:
    """Bytes that an operator has to read and write at least: what goes in and what comes out."""
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
        ANALYSIS: {
            1: partial(basis.analysis, frames[0], thetas[0]),
            k: partial(basis.analysis, frames, thetas),
        },
        SYNTHESIS: {
            1: partial(basis.synthesis, frames[0], thetas[0]),
            k: partial(basis.synthesis, frames, thetas),
        },
        SHRINK: {1: partial(run, shrink)},
    }


def _shifted(basis: HaarBasis) -> ShiftedHaar:
    n = basis.n_rows * basis.n_cols
    return ShiftedHaar(
        (basis.n_rows, basis.n_cols), np.arange(n).reshape(basis.n_rows, basis.n_cols), n
    )


def _numba_calls(phi: SbhePhi, basis: HaarBasis, frames: Floats) -> Calls:
    from sparseskin.nodes.compressor.fast_sbhe import CompiledSbhe
    from sparseskin.nodes.fast_kernels import shrink_tiled
    from sparseskin.nodes.reconstructor.fast_haar import CompiledHaar

    k, n = len(frames), phi.n
    sbhe, haar = CompiledSbhe(phi), CompiledHaar(basis.n_rows, basis.n_cols)
    x, back = frames.reshape(k, n), np.empty((k, n), np.float32)
    y = sbhe.forward(x, np.empty((k, phi.m), np.float32))
    ready(shrink_tiled)
    canvas = np.zeros(_shifted(basis).size, np.float32)
    calls: Calls = {SHRINK: {1: partial(shrink_tiled, canvas, 0.01)}}
    todo: dict[str, tuple[Callable[..., object], Floats, Floats]] = {
        FORWARD: (sbhe.forward, x, y),
        ADJOINT: (sbhe.adjoint, y, back),
        ANALYSIS: (haar.analysis, x, back),
        SYNTHESIS: (haar.synthesis, x, back),
    }
    for operator, (apply, given, out) in todo.items():
        calls[operator] = {1: partial(apply, given[:1], out[:1]), k: partial(apply, given, out)}
    return calls


def time_solvers(point: dict[str, Any]) -> dict[str, Any]:
    """Time whole frames, and single iterations beside what C makes of them.

    Parameters
    ----------
    point : dict
        side of the skin, seed, windows, n_frames.

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
        rows += [{**_frames(name, way, point, settings)} for way in ways]
        if c_compiler() is not None:
            levels = (side & -side).bit_length() - 1
            floor = CFloor(side * side, levels)
            rows.append(
                {
                    **{"solver": name, "way": C, "n": side * side},
                    **{"frame_ms": None, "p99_ms": None, "iterations": None},
                    "iteration_us": round(median_us(getattr(floor, name), point["windows"]), 3),
                }
            )
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
