"""What is computed for the paper's tables: one scene, one setting, frame by frame."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pywt

from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.reconstructor.basis import make_basis
from sparseskin.nodes.reconstructor.presets import PRESETS
from sparseskin.nodes.reconstructor.solver import Solver, make_solver
from sparseskin.nodes.sensor.noise import NoiseModel

from .scene_frames import f_max_of, first_contact, in_contact, scene_frames, shape_of

#: Forces are float32: below this a coefficient is the rounding of forces of 2.5 N.
ROUNDING_N = 1e-6
FEW_LEVELS = "sparseskin.studies.few_levels_haar:FewLevelsHaarBasis"
#: Levels of the wavelets of table II: as often as a side of 40 or of 64 can be halved (D4: not
#: more often than its four samples fit in).
LEVELS = {40: 3, 64: 6}
QUICK_BEFORE, QUICK_AFTER = 50, 150


def window(point: dict[str, Any]) -> tuple[int, int | None]:
    """First frame and end of what is looked at: everything, or, in a quick run, first contact."""
    if not point["quick"]:
        return 0, None
    contact = first_contact(point["scene"], point["seed"])
    return contact - QUICK_BEFORE, contact + QUICK_AFTER


def scene_figures(point: dict[str, Any]) -> dict[str, Any]:
    """A scene without compression: frame by frame its noise and its wavelet coefficients.

    Parameters
    ----------
    point : dict
        scene, seed, quick.

    Returns
    -------
    dict
        first: the first frame; noisy_db, contact: per frame; d2, d4: coefficients above
        rounding; d2_exact, d4_exact: coefficients that are not 0 in float64, rounding included;
        d2_shifted: mean count of D2, in contact, with the scene moved by k taxels both ways.
    """
    first, stop = window(point)
    f_max, side = f_max_of(point["scene"]), shape_of(point["scene"])[0]
    figures: dict[str, Any] = {"first": first}
    per_frame: dict[str, list[Any]] = {
        key: [] for key in ("noisy_db", "contact", "d2", "d4", "d2_exact", "d4_exact")
    }
    shifted: list[list[int]] = []
    for truth, taxels in scene_frames(point["scene"], point["seed"], first, stop):
        contact = in_contact(truth, f_max)
        per_frame["noisy_db"].append(round(psnr_db(taxels - truth, f_max), 3))
        per_frame["contact"].append(contact)
        for key, wavelet in (("d2", "db1"), ("d4", "db2")):
            sizes = _coefficients(truth, wavelet, LEVELS[side])
            per_frame[key].append(int(np.count_nonzero(sizes > ROUNDING_N)))
            per_frame[f"{key}_exact"].append(int(np.count_nonzero(sizes)))
        if contact and len(per_frame["contact"]) % 20 == 0:
            moved = [np.roll(truth, (k, k), axis=(0, 1)) for k in range(8)]
            sizes_of = [_coefficients(image, "db1", LEVELS[side]) for image in moved]
            shifted.append([int(np.count_nonzero(s > ROUNDING_N)) for s in sizes_of])
    figures["d2_shifted"] = np.mean(shifted, axis=0).round(1).tolist() if shifted else []
    return figures | per_frame


def _coefficients(image: Any, wavelet: str, levels: int) -> Any:
    """Sizes of an image's wavelet coefficients, as many as there are taxels."""
    wide = image.astype(np.float64)
    levels = min(levels, pywt.dwt_max_level(len(wide), wavelet))
    coefficients = pywt.wavedec2(wide, wavelet, mode="periodization", level=levels)
    return np.abs(pywt.coeffs_to_array(coefficients)[0])


def restored(point: dict[str, Any]) -> dict[str, Any]:
    """A scene compressed and restored.

    Parameters
    ----------
    point : dict
        scene, seed, quick; ratio (N/M), iterations, lambda_n, few_levels (whether the basis
        stops where a side gets odd).

    Returns
    -------
    dict
        psnr_db: per frame.
    """
    first, stop = window(point)
    f_max = f_max_of(point["scene"])
    solver = solver_of(point)
    psnr = [
        round(psnr_db(solver.solve(solver.phi.forward(taxels.reshape(-1))) - truth, f_max), 3)
        for truth, taxels in scene_frames(point["scene"], point["seed"], first, stop)
    ]
    return {"psnr_db": psnr}


def solver_of(point: dict[str, Any]) -> Solver:
    """The solver of a point: the paper's, but for what the point says."""
    rows, cols = shape_of(point["scene"])
    n = rows * cols
    phi = make_phi("sbhe", n=n, m=n // point["ratio"], seed=point["seed"])
    preset = PRESETS["paper"]
    # On sides of a power of two both bases are the same, and the project's own is quick.
    few = point["few_levels"] and bool(rows & (rows - 1) or cols & (cols - 1))
    basis = make_basis(FEW_LEVELS if few else preset["basis"], rows, cols)
    return make_solver(
        preset["solver"],
        phi,
        basis,
        iterations=point["iterations"],
        lambda_n=point["lambda_n"],
    )


def solve_times(point: dict[str, Any]) -> dict[str, Any]:
    """Time a frame of the solver, over frames from the first contact on.

    Parameters
    ----------
    point : dict
        As in `restored`, and n_frames.

    Returns
    -------
    dict
        median_ms, mean_ms, p99_ms.
    """
    contact = first_contact(point["scene"], point["seed"])
    solver = solver_of(point)
    spans_ns = []
    for _, taxels in scene_frames(
        point["scene"], point["seed"], contact, contact + point["n_frames"]
    ):
        y = solver.phi.forward(taxels.reshape(-1))
        begin_ns = time.perf_counter_ns()
        solver.solve(y)
        spans_ns.append(time.perf_counter_ns() - begin_ns)
    spans_ms = np.array(spans_ns) / 1e6
    return {
        "median_ms": round(float(np.median(spans_ms)), 4),
        "mean_ms": round(float(np.mean(spans_ms)), 4),
        "p99_ms": round(float(np.percentile(spans_ms, 99)), 4),
    }


def frame_maps(point: dict[str, Any]) -> dict[str, Any]:
    """Maps of some frames, restored as part of their sequence.

    Parameters
    ----------
    point : dict
        As in `restored`, without quick, and frames: numbers of frames, ascending.

    Returns
    -------
    dict
        maps: for each frame its truth, taxels and restored forces, newtons; psnr_db: of taxels
        and restored forces.
    """
    frames: list[int] = point["frames"]
    # Enough frames before for the warm start to be that of the whole sequence.
    first = max(0, frames[0] - 200)
    f_max = f_max_of(point["scene"])
    solver = solver_of(point)
    maps, psnr = [], []
    sequence = scene_frames(point["scene"], point["seed"], first, frames[-1] + 1)
    for k, (truth, taxels) in enumerate(sequence, first):
        forces = solver.solve(solver.phi.forward(taxels.reshape(-1)))
        if k in frames:
            maps.append([image.round(4).tolist() for image in (truth, taxels, forces)])
            psnr.append([round(psnr_db(image - truth, f_max), 2) for image in (taxels, forces)])
    return {"maps": maps, "psnr_db": psnr}


def untouched(point: dict[str, Any]) -> dict[str, Any]:
    """The best PSNR that an untouched skin is restored with.

    Parameters
    ----------
    point : dict
        side, seed, ratio, lambda_n, few_levels, n_frames.

    Returns
    -------
    dict
        highest_db.
    """
    side = point["side"]
    scene = {40: "lift_box_40", 64: "lift_box_64"}[side]
    solver = solver_of(point | {"scene": scene, "iterations": 30})
    noise = NoiseModel.for_range(f_max_of(scene))
    rng = np.random.default_rng(point["seed"])
    truth = np.zeros((side, side), dtype=np.float32)
    best = 0.0
    for k in range(point["n_frames"]):
        taxels = noise.apply(truth, rng)
        forces = solver.solve(solver.phi.forward(taxels.reshape(-1)))
        # The first frames have no warm start, and PSNR is no better for it.
        if k >= 5:
            best = max(best, psnr_db(forces - truth, noise.f_max))
    return {"highest_db": round(best, 3)}
