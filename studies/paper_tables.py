"""The study `paper-tables`: tables I to IV of the paper and its figures, beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .paper_charts import draw_coefficients, draw_maps, draw_sequences, draw_untouched
from .paper_numbers import ITERATIONS, PAPER, RATIOS
from .paper_page import write_paper_page
from .paper_points import frame_maps, restored, scene_figures, solve_times, untouched
from .paper_results import Results
from .points import compute
from .scene_frames import step_s

PAPER_LAMBDA_N = 0.1 / 32
#: Where the highest PSNR of an untouched skin fits the paper's best: see the chart `untouched`.
FITTED_LAMBDA_N = 0.009
LAMBDAS_N = (0.003125, 0.0045, 0.00625, 0.009, 0.0125, 0.018, 0.025)
SHOWN_FRAMES = 300
SETTINGS = ((4, 30), (3, 30), (2, 30), (3, 10), (3, 20))


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the tables and write the page.

    Parameters
    ----------
    out : Path
        Folder to write to, which exists.
    quick : bool
        Only 200 frames around the first contact of each scene.
    seed : int
        Of noise, Phi and the peg's path.
    executor : str
        Where the points are computed; solve times are measured on this host, one by one.
    """
    base: dict[str, Any] = {"seed": seed, "quick": quick}
    scenes = list(PAPER)
    figures = compute(
        scene_figures, [{"scene": scene, **base} for scene in scenes], out, executor, "scenes"
    )
    points = []
    for scene in scenes:
        for lambda_n, few, settings in (
            (PAPER_LAMBDA_N, False, SETTINGS),
            (FITTED_LAMBDA_N, True, SETTINGS[:3]),
        ):
            for ratio, iterations in settings:
                how = {"ratio": ratio, "iterations": iterations, "lambda_n": lambda_n}
                points.append({"scene": scene, **how, "few_levels": few, **base})
    psnr = compute(restored, points, out, executor, "restored")
    results = Results(
        quick=quick,
        scenes={scene: figures[k] for k, scene in enumerate(scenes)},
        psnr={
            (p["scene"], p["ratio"], p["iterations"], p["few_levels"]): f["psnr_db"]
            for p, f in zip(points, psnr, strict=True)
        },
        times=_times(out, quick, seed),
    )
    lambdas, highest = _untouched(out, quick, seed, executor)
    charts = {
        "maps": _maps(out, results, seed, executor),
        **_sequences(out, results),
        "untouched": draw_untouched(out, lambdas, highest),
        "coefficients": draw_coefficients(out, _coefficients(results), _means(results)),
    }
    write_paper_page(out, results, charts, lambdas, highest)


def _times(out: Path, quick: bool, seed: int) -> dict[tuple[str, int], dict[str, float]]:
    keys = [(scene, iterations) for scene in PAPER for iterations in ITERATIONS]
    points = [
        {
            **{"scene": scene, "seed": seed, "ratio": 3, "iterations": iterations},
            **{"lambda_n": PAPER_LAMBDA_N, "few_levels": False},
            "n_frames": 100 if quick else 1000,
        }
        for scene, iterations in keys
    ]
    times = compute(solve_times, points, out, "process:1", "solve times")
    return dict(zip(keys, times, strict=True))


def _untouched(
    out: Path, quick: bool, seed: int, executor: str
) -> tuple[tuple[float, ...], dict[tuple[int, bool, int], list[float]]]:
    lambdas = LAMBDAS_N[::2] if quick else LAMBDAS_N
    kinds = [
        (side, few, ratio)
        for side, few in ((40, False), (40, True), (64, True))
        for ratio in RATIOS
    ]
    points = [
        {
            **{"side": side, "few_levels": few, "ratio": ratio, "lambda_n": lambda_n},
            **{"seed": seed, "n_frames": 60 if quick else 500},
        }
        for side, few, ratio in kinds
        for lambda_n in lambdas
    ]
    found = iter(compute(untouched, points, out, executor, "untouched skin"))
    return lambdas, {kind: [next(found)["highest_db"] for _ in lambdas] for kind in kinds}


def _maps(out: Path, results: Results, seed: int, executor: str) -> str:
    """The frames of the paper's figure of forces: drag_wrench_64, N/3, 20 iterations."""
    scene = "drag_wrench_64"
    psnr = np.array(results.psnr[scene, 3, 20, False])
    contact = np.flatnonzero(results.scenes[scene]["contact"])
    first = results.scenes[scene]["first"]
    by_psnr = contact[np.argsort(psnr[contact])]
    chosen = {
        "representative": int(by_psnr[len(by_psnr) // 2]) + first,
        "worst": int(by_psnr[0]) + first,
    }
    frames = sorted(chosen.values())
    point = {
        **{"scene": scene, "seed": seed, "ratio": 3, "iterations": 20},
        **{"lambda_n": PAPER_LAMBDA_N, "few_levels": False, "frames": frames},
    }
    (found,) = compute(frame_maps, [point], out, executor, "maps")
    rows = []
    for what, frame in chosen.items():
        k = frames.index(frame)
        rows.append((f"{what}, {frame * step_s(scene) * 1e3:.1f} ms", *_kth(found, k)))
    return draw_maps(out, rows, "DRAG WRENCH 64 x 64, restored from 1365 numbers, 20 iterations")


def _kth(found: dict[str, Any], k: int) -> tuple[Any, Any]:
    return found["maps"][k], found["psnr_db"][k]


def _sequences(out: Path, results: Results) -> dict[str, str]:
    """PSNR over time, by M in DRAG WRENCH and by iterations in LIFT BOX, 64 x 64."""
    by_m = {f"M = N/{ratio}": (ratio, 30) for ratio in RATIOS}
    by_k = {f"{k} iterations": (3, k) for k in ITERATIONS}
    charts = {}
    for name, scene, settings in (
        ("psnr_by_m", "drag_wrench_64", by_m),
        ("psnr_by_iterations", "lift_box_64", by_k),
    ):
        figures = results.scenes[scene]
        contact = np.array(figures["contact"])
        begins = {
            "representative": _longest_contact(contact),
            "first contact": max(0, int(np.argmax(contact)) - 50),
        }
        panels = []
        for title, begin in begins.items():
            part = slice(begin, min(begin + SHOWN_FRAMES, len(contact)))
            frames = np.arange(part.start, part.stop) + figures["first"]
            series = {
                label: results.psnr[scene, *how, False][part] for label, how in settings.items()
            }
            series["noisy"] = figures["noisy_db"][part]
            panels.append((title, (frames * step_s(scene) * 1e3).tolist(), series))
        caption = f"PSNR over time, {PAPER[scene].title} 64 x 64, preset paper"
        charts[name] = draw_sequences(out, name, panels, caption)
    return charts


def _longest_contact(contact: npt.NDArray[np.bool_]) -> int:
    """Where the middle frames of the longest contact begin: forces change slowly there."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], contact, [False]])))
    begins, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - begins))
    middle = int(begins[longest] + ends[longest]) // 2
    return max(0, middle - SHOWN_FRAMES // 2)


def _coefficients(results: Results) -> dict[int, tuple[list[float], list[float]]]:
    by_n: dict[int, tuple[list[float], list[float]]] = {1600: ([], []), 4096: ([], [])}
    for scene, figures in results.scenes.items():
        frames = np.flatnonzero(figures["contact"])
        # A tenth of the frames shows as much, in a file that can be opened.
        chosen = frames[:: 1 if results.quick else 10]
        counts, psnr = by_n[PAPER[scene].n]
        counts += np.array(figures["d2"])[chosen].tolist()
        psnr += np.array(results.psnr[scene, 3, 30, False])[chosen].tolist()
    return by_n


def _means(results: Results) -> dict[str, tuple[float, float]]:
    """Number of D2 coefficients and PSNR from N/3, means over all frames."""
    return {
        scene: (
            float(np.mean(figures["d2"])),
            float(np.mean(results.psnr[scene, 3, 30, False])),
        )
        for scene, figures in results.scenes.items()
    }
