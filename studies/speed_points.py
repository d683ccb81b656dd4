"""What is computed for `speed-accuracy`: one solver on one scene, timed frame by frame."""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Measurements, Taxels
from sparseskin.messages.wire import size_bytes
from sparseskin.nodes.compressor.phi import Phi, make_phi
from sparseskin.nodes.compressor.rotation import FIXED, phases_of
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.reconstructor.basis import make_basis
from sparseskin.nodes.reconstructor.rotating import make_rotating_solver

from .scene_frames import (
    Floats,
    f_max_of,
    first_contact,
    in_contact,
    n_steps_of,
    scene_frames,
    shape_of,
    step_s,
)

#: What is no setting of the solver.
_OF_THE_POINT = ("scene", "seed", "short", "label", "phi", "rows", "ratio", "solver", "basis")
#: Frames are 1 ms apart in all scenes, whatever their own step.
PERIOD_S = 1e-3
BEFORE, AFTER, LATER = 20, 180, 200
SHORT_AFTER, SHORT_LATER = 40, 40
DEAD_ZONES_N = (0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.07, 0.1)


@cache
def sequences(scene: str, seed: int, short: bool) -> tuple[tuple[Floats, Floats], ...]:
    """Truth and taxels of two parts of a scene: around its first contact, and half way on.

    Returns
    -------
    tuple of (truth, taxels)
        float32, shape (k, n_rows, n_cols), newtons; frames 1 ms apart.
    """
    every = max(1, round(PERIOD_S / step_s(scene)))
    contact = first_contact(scene, seed)
    begins = (contact - BEFORE * every, (contact + n_steps_of(scene)) // 2)
    lengths = (BEFORE + (SHORT_AFTER if short else AFTER), SHORT_LATER if short else LATER)
    found = []
    for first, length in zip(begins, lengths, strict=True):
        frames = list(scene_frames(scene, seed, first, first + length * every, every))
        truth, taxels = (np.stack(images) for images in zip(*frames, strict=True))
        found.append((truth, taxels))
    return tuple(found)


def phases_for(point: dict[str, Any]) -> list[Phi]:
    """The measurement matrix of a point; where its rows rotate, those that frames take in turn."""
    n_rows, n_cols = shape_of(point["scene"])
    n, ratio, rows = n_rows * n_cols, point["ratio"], point.get("rows", FIXED)
    m = n // ratio if rows == FIXED else -(-n // ratio)
    return phases_of(make_phi(point["phi"], n=n, m=m, seed=point["seed"]), rows)


def timed(point: dict[str, Any]) -> dict[str, Any]:
    """Restore a scene's frames, each timed by itself.

    Parameters
    ----------
    point : dict
        scene, seed, short, phi, rows ("fixed" where it is not there), ratio, solver, basis, and
        the solver's settings.

    Returns
    -------
    dict
        As `judged`; median_ms, processor time a frame; p99_ms, time by the clock; cpu_share, the
        part of that time that the process had a core; bytes of a measurements message; done, the
        mean number of iterations.
        Or refused: why these do not go together.
    """
    try:
        return _timed(point)
    except SparseskinError as error:
        return {"refused": str(error)}


def _timed(point: dict[str, Any]) -> dict[str, Any]:
    settings = {key: value for key, value in point.items() if key not in _OF_THE_POINT}
    phases = phases_for(point)
    basis = make_basis(point["basis"], *shape_of(point["scene"]))
    solver = make_rotating_solver(point["solver"], phases, basis, **settings)
    spans_ns: list[int] = []
    cpu_ns: list[int] = []
    n_steps = []
    restored = []
    for _, taxels in sequences(point["scene"], point["seed"], point["short"]):
        solver.reset()
        images = np.empty_like(taxels)
        for k, frame in enumerate(taxels):
            phi = phases[k % len(phases)]
            y = phi.forward(frame.reshape(-1))
            solver.use(phi)
            begin_ns, cpu_begin_ns = time.perf_counter_ns(), time.thread_time_ns()
            forces = solver.solve(y)
            cpu_ns.append(time.thread_time_ns() - cpu_begin_ns)
            spans_ns.append(time.perf_counter_ns() - begin_ns)
            n_steps.append(solver.n_steps)
            images[k] = forces
        restored.append(images)
    message = Measurements(stamp_ns=0, patch="skin", y=y, phi=phi.fingerprint)
    return {
        **judged(point, restored),
        "median_ms": round(float(np.median(cpu_ns)) / 1e6, 4),
        "p99_ms": round(float(np.percentile(spans_ns, 99)) / 1e6, 4),
        "cpu_share": round(sum(cpu_ns) / sum(spans_ns), 3),
        "bytes": size_bytes(message),
        "done": round(float(np.mean(n_steps)), 2),
    }


def judged(point: dict[str, Any], restored: list[Floats]) -> dict[str, float]:
    """How good images are, over the frames in contact.

    Returns
    -------
    dict
        mean_db, worst_db: PSNR; touched_mn: root mean square error of the taxels that bear more
        than 0.4 % of the range, in millinewtons.
    """
    f_max = f_max_of(point["scene"])
    psnr, touched = [], []
    parts = sequences(point["scene"], point["seed"], point["short"])
    for (truth, _), images in zip(parts, restored, strict=True):
        for true, image in zip(truth, images, strict=True):
            if in_contact(true, f_max):
                psnr.append(psnr_db(image - true, f_max))
                cells: npt.NDArray[np.bool_] = true > 0.004 * f_max
                touched.append(np.square(image - true, dtype=np.float64)[cells])
    rmse_n = float(np.sqrt(np.mean(np.concatenate(touched))))
    return {
        "mean_db": round(float(np.mean(psnr)), 3),
        "worst_db": round(float(np.min(psnr)), 3),
        "touched_mn": round(rmse_n * 1e3, 3),
    }


def full_reading(point: dict[str, Any]) -> dict[str, Any]:
    """The noisy taxels themselves, all N of them sent, with dead zones of several widths.

    Parameters
    ----------
    point : dict
        scene, seed, short.

    Returns
    -------
    dict
        bytes of a taxels message; by_dead_zone: for each of `DEAD_ZONES_N`, as `judged`.
    """
    parts = sequences(point["scene"], point["seed"], point["short"])
    message = Taxels(stamp_ns=0, patch="skin", forces=parts[0][1][0])
    return {
        "bytes": size_bytes(message),
        "by_dead_zone": [
            judged(point, [np.where(taxels < width_n, 0, taxels) for _, taxels in parts])
            for width_n in DEAD_ZONES_N
        ],
    }
