"""Frames of many patches, and the time that a solver takes for them."""

from __future__ import annotations

import time
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.batch.solver import BatchFrame, BatchSolver
from sparseskin.nodes.reconstructor.skin.evidence import SMOOTH
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.scene_frames import first_contact, scene_frames, scene_of

SCENE, EVERY, RATIO = "drag_wrench_64", 10, 3
#: Frames before the first contact, and frames between the begin of two patches.
BEFORE, APART = 20, 7
#: Patches that differ; a larger batch repeats them.
DIFFERENT = 16
#: Frames before those that are timed: graphs are captured, and the first contacts are over.
WARM_UP = 45
#: Devices that are no device of `Backend`: patches one by one, by `SkinSolver`.
ONE_BY_ONE = "one by one"

Point = dict[str, Any]


class Patches(NamedTuple):
    """Measurements and true forces of the patches that differ.

    Attributes
    ----------
    phi : Phi
    y : ndarray of float32, shape (n_frames, DIFFERENT, m)
    truth : ndarray of float32, shape (n_frames, DIFFERENT, n_rows, n_cols)
        Newtons.
    """

    phi: Phi
    y: Floats
    truth: Floats


@cache
def patches_of(n_frames: int, seed: int, idle: float) -> Patches:
    """Frames of a wrench that is dragged over each patch, 1 ms apart, each patch at its own time.

    Of the patches, a part `idle` is untouched.
    """
    last = n_frames + APART * DIFFERENT
    first = max(0, first_contact(SCENE, seed) - BEFORE * EVERY)
    frames = scene_frames(SCENE, seed, first, first + last * EVERY, EVERY)
    scene = np.array([truth for truth, _ in frames])
    n_rows, n_cols = scene_of(SCENE).shape
    phi = make_phi("sbhe", n_rows * n_cols, n_rows * n_cols // RATIO, seed)
    noise, rng = NoiseModel.for_range(PAPER_F_MAX_N), np.random.default_rng(seed)
    truth = np.zeros((n_frames, DIFFERENT, n_rows, n_cols), dtype=np.float32)
    for patch in range(DIFFERENT - round(idle * DIFFERENT)):
        truth[:, patch] = scene[APART * patch : APART * patch + n_frames]
    y = [phi.forward(noise.apply(one, rng).reshape(DIFFERENT, -1)) for one in truth]
    return Patches(phi, np.array(y), truth)


def batch_of(point: Point, phi: Phi) -> BatchSolver:
    """The batch solver of a point."""
    mask = np.ones(scene_of(SCENE).shape, dtype=np.bool_)
    return BatchSolver([phi], mask, point["patches"], device=point["device"], mode=point["mode"])


def time_patches(point: Point) -> dict[str, Any]:
    """Time the frames of a batch, each from the call until its numbers are on the host.

    `point`: device, mode, patches, n_frames, seed, idle, host (True: measurements come from the
    host and forces go there, else both stay on the device).

    Returns
    -------
    dict
        frames_hz, mean rate of frames of all patches; p50_ms, p99_ms, max_ms of a frame;
        iterations, mean of a patch; smooth, part of the patches with the smooth model; name of the
        device.
    """
    n_patches, n_frames = point["patches"], point["n_frames"]
    known = patches_of(WARM_UP + n_frames, point["seed"], point["idle"])
    chosen = np.arange(n_patches) % DIFFERENT
    if point["device"] == ONE_BY_ONE:
        return _time_one_by_one(known, chosen)
    solver = batch_of(point, known.phi)
    spans_s, iterations, smooth = [], [], []
    given = [np.ascontiguousarray(y[chosen]) for y in known.y]
    if not point["host"]:
        given = [solver.backend.array(y) for y in given]
    for k, y in enumerate(given):
        begin_s = time.perf_counter()
        _, frame = solver.advance(y, with_forces=point["host"])
        if k >= WARM_UP:
            spans_s.append(time.perf_counter() - begin_s)
            iterations.append(frame.n_steps.mean())
            smooth.append(frame.is_smooth.mean())
    return _figures(spans_s, iterations, smooth, solver.backend.name)


def _time_one_by_one(known: Patches, chosen: npt.NDArray[np.int64]) -> dict[str, Any]:
    shape = scene_of(SCENE).shape
    solvers = [SkinSolver(known.phi, make_basis("haar", *shape)) for _ in chosen]
    spans_s, iterations, smooth = [], [], []
    for k, y in enumerate(known.y):
        begin_s = time.perf_counter()
        for solver, place in zip(solvers, chosen, strict=True):
            solver.solve(y[place])
        if k >= WARM_UP:
            spans_s.append(time.perf_counter() - begin_s)
            iterations.append(np.mean([solver.n_steps for solver in solvers]))
            smooth.append(np.mean([solver.model == SMOOTH for solver in solvers]))
    return _figures(spans_s, iterations, smooth, ONE_BY_ONE)


def _figures(
    spans_s: list[float], iterations: list[Any], smooth: list[Any], name: str
) -> dict[str, Any]:
    """Return what `time_patches` does, of each frame's time, iterations and smooth patches."""
    spans_ms = 1e3 * np.array(spans_s)
    return {
        "frames_hz": round(1e3 / float(spans_ms.mean()), 1),
        "p50_ms": round(float(np.median(spans_ms)), 4),
        "p99_ms": round(float(np.percentile(spans_ms, 99)), 4),
        "max_ms": round(float(spans_ms.max()), 4),
        "iterations": round(float(np.mean(iterations)), 2),
        "smooth": round(float(np.mean(smooth)), 4),
        "name": name,
    }


def compare(point: Point) -> dict[str, Any]:
    """Compare a device with numpy, over the frames of some patches.

    `point`: device, mode, patches, n_frames, seed, idle.

    Returns
    -------
    dict
        largest_n, largest difference of a force in frames before any decision differs; same, part
        of frames and patches up to there; numpy_db, device_db: mean PSNR of all frames in contact.
    """
    known = patches_of(point["n_frames"], point["seed"], point["idle"])
    solvers = batch_of({**point, "device": "numpy"}, known.phi), batch_of(point, known.phi)
    n_patches = point["patches"]
    same = np.ones(n_patches, dtype=np.bool_)
    largest, n_same = 0.0, 0
    found_db: tuple[list[float], list[float]] = ([], [])
    for y, truth in zip(known.y[:, :n_patches], known.truth[:, :n_patches], strict=True):
        mine, other = (_copied(solver.solve(y.copy())) for solver in solvers)
        decided = (mine.n_steps == other.n_steps) & (mine.is_smooth == other.is_smooth)
        # The smooth model amplifies rounding by itself.
        same &= decided & ~mine.is_smooth & (mine.trusted == other.trusted)
        n_same += int(same.sum())
        if same.any():
            largest = max(largest, float(np.abs(mine.forces - other.forces)[same].max()))
        for db, frame in zip(found_db, (mine, other), strict=True):
            touched = [k for k in range(n_patches) if truth[k].max() > 0]
            db += [psnr_db(frame.forces[k] - truth[k], PAPER_F_MAX_N) for k in touched]
    return {
        "largest_n": float(f"{largest:.3g}"),
        "same": round(n_same / (n_patches * len(known.y)), 4),
        "numpy_db": round(float(np.mean(found_db[0])), 3),
        "device_db": round(float(np.mean(found_db[1])), 3),
    }


def _copied(frame: BatchFrame) -> BatchFrame:
    return BatchFrame(**{name: array.copy() for name, array in vars(frame).items()})
