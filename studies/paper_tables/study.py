"""Study `paper-tables`: tables I to IV of the paper and its figures, beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pywt

from sparseskin.nodes.compressor.phi.rotation import PAPER as PAPER_ROWS
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.evaluate import Method, evaluate_one, in_contact, make_method
from sparseskin.studies.points import compute, compute_rows
from sparseskin.studies.scene_frames import first_contact, scene_frames, scene_of

from .numbers import ITERATIONS, PAPER, RATIOS
from .page import MAPPED, Results, write

PAPER_LAMBDA_N = 0.1 / 32
#: Where the highest PSNR of an untouched skin fits the paper's best: see the chart `untouched`.
FITTED_LAMBDA_N = 0.009
LAMBDAS_N = (0.003125, 0.0045, 0.00625, 0.009, 0.0125, 0.018, 0.025)
#: Part of a point: the paper's method at M = N/3.
PAPER_POINT = {"ratio": 3, "lambda_n": PAPER_LAMBDA_N, "few_levels": False}
#: N / M and iterations.
SETTINGS = ((4, 30), (3, 30), (2, 30), (3, 10), (3, 20))
#: Below this a coefficient is the rounding of float32 forces of 2.5 N, newtons.
ROUNDING_N = 1e-6
FEW_LEVELS = "sparseskin.studies.paper_tables.few_levels_haar:FewLevelsHaarBasis"
#: Levels of the wavelets of table II: as often as a side of 40 or of 64 can be halved (D4: not
#: more often than its four samples fit in).
LEVELS = {40: 3, 64: 6}
QUICK_BEFORE, QUICK_AFTER = 50, 150
#: Frames before the first map: the warm start is then that of the whole sequence.
BEFORE_MAPS = 200

Point = dict[str, Any]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the tables and write the page; see `command.Study`.

    Solve times are measured on this host, one by one, whatever the executor.
    """
    base: dict[str, Any] = {"seed": seed, "quick": quick}
    by_scene = [{"scene": scene, **base} for scene in PAPER]
    figures = compute(scene_figures, by_scene, out, executor, "scenes")
    points: list[Point] = [
        {**point, "ratio": ratio, "iterations": k, "lambda_n": lambda_n, "few_levels": few}
        for point in by_scene
        for lambda_n, few, settings in (
            (PAPER_LAMBDA_N, False, SETTINGS),
            (FITTED_LAMBDA_N, True, SETTINGS[:3]),
        )
        for ratio, k in settings
    ]
    psnr = compute_rows(reconstructed, points, out, executor, "PSNR")
    keys = ("scene", "ratio", "iterations", "few_levels")
    results = Results(
        quick=quick,
        scenes=dict(zip(PAPER, figures, strict=True)),
        psnr={tuple(row[key] for key in keys): row["psnr_db"] for row in psnr},
        times=_times(out, quick, seed),
    )
    lambdas, highest = _untouched(out, quick, seed, executor)
    chosen = results.chosen_frames(MAPPED)
    frames = sorted(chosen.values())
    point = {"scene": MAPPED, "iterations": 20, **PAPER_POINT, "seed": seed, "frames": frames}
    (found,) = compute(frame_maps, [point], out, executor, "maps")
    maps = [
        (title, frame, found["maps"][frames.index(frame)], found["psnr_db"][frames.index(frame)])
        for title, frame in chosen.items()
    ]
    write(out, results, lambdas, highest, maps)


def _times(out: Path, quick: bool, seed: int) -> dict[tuple[str, int], dict[str, float]]:
    keys = [(scene, iterations) for scene in PAPER for iterations in ITERATIONS]
    common = {**PAPER_POINT, "seed": seed, "n_frames": 100 if quick else 1000}
    points = [{"scene": scene, "iterations": k, **common} for scene, k in keys]
    times = compute(solve_times, points, out, "process:1", "solve times")
    return dict(zip(keys, times, strict=True))


def _untouched(
    out: Path, quick: bool, seed: int, executor: str
) -> tuple[tuple[float, ...], dict[tuple[int, bool, int], list[float]]]:
    lambdas = LAMBDAS_N[::2] if quick else LAMBDAS_N
    kinds = [(*of, ratio) for of in ((40, False), (40, True), (64, True)) for ratio in RATIOS]
    common = {"seed": seed, "n_frames": 60 if quick else 500}
    points = [
        {"side": side, "few_levels": few, "ratio": ratio, "lambda_n": lambda_n, **common}
        for side, few, ratio in kinds
        for lambda_n in lambdas
    ]
    found = iter(compute(untouched, points, out, executor, "untouched skin"))
    return lambdas, {kind: [next(found)["highest_db"] for _ in lambdas] for kind in kinds}


def window(point: Point) -> tuple[int, int | None]:
    """First frame and end of the frames: all; in a quick run, those around the first contact."""
    if not point["quick"]:
        return 0, None
    contact = first_contact(point["scene"], point["seed"])
    return contact - QUICK_BEFORE, contact + QUICK_AFTER


def scene_figures(point: Point) -> dict[str, Any]:
    """A scene without compression: frame by frame its noise and its wavelet coefficients.

    `point`: scene, seed, quick.

    Returns
    -------
    dict
        first: the first frame; noisy_db, contact: per frame; d2, d4: coefficients above
        rounding; d2_exact, d4_exact: coefficients that are not 0 in float64, rounding included;
        d2_shifted: mean count of D2, in contact, with the scene moved by k taxels both ways.
    """
    first, stop = window(point)
    f_max, side = scene_of(point["scene"]).f_max_n, scene_of(point["scene"]).shape[0]
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
    mean_shifted = np.mean(shifted, axis=0).round(1).tolist() if shifted else []
    return {"first": first, "d2_shifted": mean_shifted, **per_frame}


def _coefficients(image: Any, wavelet: str, levels: int) -> Any:
    """Sizes of an image's wavelet coefficients, as many as there are taxels."""
    wide = image.astype(np.float64)
    levels = min(levels, pywt.dwt_max_level(len(wide), wavelet))
    coefficients = pywt.wavedec2(wide, wavelet, mode="periodization", level=levels)
    return np.abs(pywt.coeffs_to_array(coefficients)[0])


def reconstructed(point: Point) -> dict[str, Any]:
    """Reconstruct a scene from its measurements.

    `point`: scene, seed, quick; ratio (N/M), iterations, lambda_n, few_levels (true if the basis
    stops where a side gets odd).

    Returns
    -------
    dict
        psnr_db: per frame.
    """
    frames = scene_frames(point["scene"], point["seed"], *window(point))
    scores = evaluate_one(method_of(point), frames, scene_of(point["scene"]).f_max_n)
    return {"psnr_db": [round(psnr, 3) for psnr in scores.psnr_db]}


def method_of(point: Point) -> Method:
    """Make the method of a point: the paper's, but for the settings of the point."""
    shape = scene_of(point["scene"]).shape
    # On sides of a power of two both bases are the same, and the project's own is quick.
    few = point["few_levels"] and any(side & (side - 1) for side in shape)
    settings = {key: point[key] for key in ("iterations", "lambda_n")}
    chosen = PRESETS["paper"] | settings | ({"basis": FEW_LEVELS} if few else {})
    return make_method(chosen, shape, point["ratio"], point["seed"], rows=PAPER_ROWS)


def solve_times(point: Point) -> dict[str, Any]:
    """Time the solver on the frames from the first contact on.

    `point`: As in `reconstructed`, and n_frames.

    Returns
    -------
    dict
        median_ms, mean_ms, p99_ms.
    """
    contact = first_contact(point["scene"], point["seed"])
    frames = scene_frames(point["scene"], point["seed"], contact, contact + point["n_frames"])
    scores = evaluate_one(method_of(point), frames, scene_of(point["scene"]).f_max_n)
    return {
        "median_ms": round(scores.wall_ms(50), 4),
        "mean_ms": round(1e3 * float(np.mean(scores.wall_s)), 4),
        "p99_ms": round(scores.wall_ms(99), 4),
    }


def frame_maps(point: Point) -> dict[str, Any]:
    """Reconstruct maps of some frames, as part of their sequence.

    `point`: As in `reconstructed`, without quick, and frames: numbers of frames, ascending.

    Returns
    -------
    dict
        maps: for each frame its truth, taxels and reconstructed forces, newtons; psnr_db: of taxels
        and reconstructed forces.
    """
    frames: list[int] = point["frames"]
    first = max(0, frames[0] - BEFORE_MAPS)
    f_max = scene_of(point["scene"]).f_max_n
    method = method_of(point)
    maps, psnr = [], []
    sequence = scene_frames(point["scene"], point["seed"], first, frames[-1] + 1)
    for k, (truth, taxels) in enumerate(sequence, first):
        forces = method.reconstruct(taxels).forces
        if k in frames:
            maps.append([image.round(4).tolist() for image in (truth, taxels, forces)])
            psnr.append([round(psnr_db(image - truth, f_max), 2) for image in (taxels, forces)])
    return {"maps": maps, "psnr_db": psnr}


def untouched(point: Point) -> dict[str, Any]:
    """Highest PSNR of a reconstructed untouched skin.

    `point`: side, seed, ratio, lambda_n, few_levels, n_frames.

    Returns
    -------
    dict
        highest_db.
    """
    side = point["side"]
    method = method_of(point | {"scene": f"lift_box_{side}", "iterations": 30})
    noise = NoiseModel()
    rng = np.random.default_rng(point["seed"])
    truth = np.zeros((side, side), dtype=np.float32)
    frames = ((truth, noise.apply(truth, rng)) for _ in range(point["n_frames"]))
    scores = evaluate_one(method, frames)
    # The first frames have no warm start, and PSNR is no better for it.
    return {"highest_db": round(max(scores.psnr_db[5:]), 3)}
