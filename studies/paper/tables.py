"""Study `paper-tables`: tables I to IV of the paper and its figures, beside ours."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pywt

from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.reconstructor.bases.haar import SeparableBasis, level_matrix
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.touch import in_contact
from sparseskin.studies.frames import SceneFrames, UntouchedFrames, scene_of
from sparseskin.studies.harness import (
    PAPER_ROWS,
    Candidate,
    Experiment,
    Measurement,
    unrefused,
)
from sparseskin.studies.points import compute
from sparseskin.studies.report import Page

from .charts import draw_maps, draw_sequences
from .numbers import (
    FITTED,
    ITERATIONS,
    PAPER,
    RATIOS,
    Counts,
    Highest,
    Psnr,
    Results,
    deviations_db,
    upper_ends,
)

#: Where the highest PSNR of an untouched skin fits the paper's best: see the chart `untouched`.
FITTED_LAMBDA_N = 0.009
LAMBDAS_N = (0.003125, 0.0045, 0.00625, 0.009, 0.0125, 0.018, 0.025)
#: Below this a coefficient is the rounding of float32 forces of 2.5 N, newtons.
ROUNDING_N = 1e-6
FEW_LEVELS = "sparseskin.studies.paper.tables:FewLevelsHaarBasis"
#: Levels of the wavelets of table II: as often as a side of 40 or of 64 can be halved (D4: not
#: more often than its four samples fit in).
LEVELS = {40: 3, 64: 6}
#: Scene of the paper's figure of forces, N/3, 20 iterations; frames before the first map: the
#: warm start is then that of the whole sequence.
MAPPED = "drag_wrench_64"
BEFORE_MAPS = 200

Row = dict[str, Any]


class FewLevelsHaarBasis(SeparableBasis):
    """Orthonormal 2-D Haar of as many levels as both sides are even.

    The project's own Haar goes down to one approximation coefficient on a grid of any size.
    Many a library stops where a side gets odd: on 40 x 40 after three levels, with 5 x 5
    approximations left. With sides of a power of two the two are one basis.
    """

    def __init__(self, n_rows: int, n_cols: int) -> None:
        # The lowest bit that is set in either: how often 2 divides both.
        sides = n_rows | n_cols
        lowest_bit = sides & -sides
        levels = lowest_bit.bit_length() - 1
        super().__init__(n_rows, n_cols, level_matrix, levels)


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute the tables, write the page and return its conclusion; see `command.Study`.

    Solve times are measured on this host, one by one, whatever the executor.
    """
    windows = {scene: window(scene, quick) for scene in PAPER}
    points = [{"frames": asdict(frames), "seed": seed} for frames in windows.values()]
    figures = compute(scene_figures, points, out, executor, "scenes")
    rows = pd.concat(
        unrefused(experiment.run(out, executor)) for experiment in psnr(windows, seed)
    )
    timed = unrefused(times(quick, seed).run(out, executor))
    of_frames = {}
    columns = ("scene", "ratio", "method", "psnr_db")
    for scene, ratio, method, of_each_db in rows[[*columns]].itertuples(index=False):
        of_frames[scene, ratio, method] = np.array(of_each_db)
    results = Results(
        quick=quick,
        scenes=dict(zip(PAPER, figures, strict=True)),
        psnr=of_frames,
        times_ms=timed.set_index(["scene", "method"])["mean_ms"].to_dict(),
    )
    lambdas, highest = untouched(out, quick, seed, executor)
    frame_of_title = results.chosen_frames(MAPPED)
    frames = sorted(frame_of_title.values())
    asked = [{"frames": frames, "seed": seed}]
    (maps_of_frames,) = compute(frame_maps, asked, out, executor, "maps")
    maps = {}
    for title, frame in frame_of_title.items():
        k = frames.index(frame)
        maps[title] = (
            frame,
            maps_of_frames["maps"][k],
            maps_of_frames["psnr_db"][k],
        )
    return write(out, results, lambdas, highest, maps)


def window(scene: str, quick: bool) -> SceneFrames:
    """All frames of a scene; in a quick run, those around the first contact."""
    return SceneFrames(scene, -50, 150) if quick else SceneFrames(scene, None)


def candidate(basis: str = "haar", **settings: Any) -> Candidate:
    """The paper's method, with some other settings."""
    return Candidate(
        {
            **PRESETS["paper"],
            "basis": basis,
            **settings,
        },
        changes={"rows": PAPER_ROWS},
    )


def psnr(windows: Mapping[str, SceneFrames], seed: int) -> Iterator[Experiment]:
    """PSNR of each frame by M with 30 iterations, and at N/3 by iterations."""
    for side in LEVELS:
        frames = []
        for scene, window in windows.items():
            if scene_of(scene).shape[0] == side:
                frames.append(window)
        # On sides of a power of two both bases are the same, and the project's own is quick.
        basis = FEW_LEVELS if side == 40 else "haar"
        by_m = {"30": candidate(), FITTED: candidate(basis, lambda_n=FITTED_LAMBDA_N)}
        ratios = [Measurement(ratio) for ratio in RATIOS]
        yield Experiment("PSNR", frames, ratios, by_m, ("psnr_db",), (seed,))
        by_k = {str(k): candidate(iterations=k) for k in ITERATIONS[:-1]}
        yield Experiment("PSNR", frames, [Measurement(3)], by_k, ("psnr_db",), (seed,))


def times(quick: bool, seed: int) -> Experiment:
    """Solve times from the first contact on, at N/3 by iterations."""
    frames = [SceneFrames(scene, 0, 100 if quick else 1000) for scene in PAPER]
    by_k = {str(k): candidate(iterations=k) for k in ITERATIONS}
    return Experiment(
        "solve times", frames, [Measurement(3)], by_k, ("mean_ms",), (seed,), timed=True
    )


def untouched(
    out: Path, quick: bool, seed: int, executor: str
) -> tuple[tuple[float, ...], dict[tuple[int, bool, int], list[float]]]:
    """Highest PSNR of a reconstructed untouched skin, by (side, few levels, N / M), for lambdas."""
    lambdas = LAMBDAS_N[::2] if quick else LAMBDAS_N
    measurements = [Measurement(ratio) for ratio in RATIOS]
    highest = {}
    for side, few, basis in (
        (40, False, "haar"),
        (40, True, FEW_LEVELS),
        (64, True, "haar"),
    ):
        by_lambda = {f"{x:g}": candidate(basis, lambda_n=x) for x in lambdas}
        frames = [UntouchedFrames(side, 60 if quick else 500)]
        label = f"untouched skin, {side}, {'few' if few else 'all'} levels"
        experiment = Experiment(
            label, frames, measurements, by_lambda, ("highest_db",), (seed,)
        )
        rows = unrefused(experiment.run(out, executor))
        for ratio, of_ratio in rows.groupby("ratio", sort=False):
            highest[side, few, int(ratio)] = of_ratio["highest_db"].tolist()
    return lambdas, highest


def scene_figures(point: Row) -> Row:
    """A scene, a `SceneFrames`, without compression: first: its first frame; of each frame
    noisy_db, contact, d2 and d4: wavelet coefficients above rounding; d2_exact, d4_exact: those
    that are not 0 in float64, rounding included.
    """
    frames = SceneFrames(**point["frames"])
    take = frames.open(point["seed"])
    per_frame = defaultdict[str, list[Any]](list)
    levels = LEVELS[take.mask.shape[0]]
    for truth, taxels in chain(*take.parts()):
        per_frame["noisy_db"].append(round(psnr_db(taxels - truth, take.f_max), 3))
        per_frame["contact"].append(in_contact(truth, take.f_max))
        for key, wavelet in (("d2", "db1"), ("d4", "db2")):
            sizes = _coefficients(truth, wavelet, levels)
            per_frame[key].append(int(np.count_nonzero(sizes > ROUNDING_N)))
            per_frame[f"{key}_exact"].append(int(np.count_nonzero(sizes)))
    begin, _ = next(frames.windows(point["seed"]))
    return {"first": begin, **per_frame}


def _coefficients(image: Any, wavelet: str, levels: int) -> Any:
    """Sizes of an image's wavelet coefficients, as many as there are taxels."""
    wide = image.astype(np.float64)
    levels = min(levels, pywt.dwt_max_level(len(wide), wavelet))
    # Periodic: no coefficient more than there are taxels.
    coefficients = pywt.wavedec2(wide, wavelet, mode="periodization", level=levels)
    in_one_array, _ = pywt.coeffs_to_array(coefficients)
    return np.abs(in_one_array)


def frame_maps(point: Row) -> Row:
    """Reconstruct maps of some frames of `MAPPED`, numbers ascending, as part of their sequence:
    truth, taxels and reconstructed forces, newtons, and the psnr_db of the latter two.
    """
    numbers: list[int] = point["frames"]
    whole_scene = SceneFrames(MAPPED, None)
    contact, _ = next(SceneFrames(MAPPED, 0).windows(point["seed"]))
    begin = max(0, numbers[0] - BEFORE_MAPS)
    # `SceneFrames` counts from the first contact, the numbers from the begin of the scene.
    window = SceneFrames(MAPPED, begin - contact, numbers[-1] + 1 - contact)
    take = window.open(point["seed"])
    of_20 = candidate(iterations=20)
    method = of_20.make(Measurement(3), whole_scene.open(0), point["seed"])
    maps = []
    psnr = []
    for k, (truth, taxels) in enumerate(chain(*take.parts()), begin):
        forces = method.reconstruct(taxels).forces
        if k not in numbers:
            continue
        images = (truth, taxels, forces)
        maps.append([image.round(4).tolist() for image in images])
        off_db = [psnr_db(image - truth, take.f_max) for image in (taxels, forces)]
        psnr.append([round(db, 2) for db in off_db])
    return {"maps": maps, "psnr_db": psnr}


def write(
    out: Path, results: Results, lambdas: tuple[float, ...], highest: Highest, maps: Any
) -> list[str]:
    """Write tables, charts and the page; `highest` in the order of `lambdas`, in newtons."""
    page = Page(
        out, "paper-tables", Path(__file__).with_name("notes.md"), results.quick
    )
    page.section("")
    by_m, by_k = (draw_sequences(out, results, by) for by in ("M", "iterations"))
    for title, name, rows, charts in (
        ("Table I: steps", "table_1", map(results.steps, PAPER), ()),
        ("Table II: coefficients that are not zero", "table_2", table_2(results), ()),
        ("The noisy signal, of tables III and IV", "noisy", noisy(results), ()),
        (
            "Table III: PSNR by M, 30 iterations",
            "table_3",
            table_3(results, "30"),
            (by_m,),
        ),
        (
            "Table IV: iterations and time, M = N/3",
            "table_4",
            table_4(results),
            (by_k,),
        ),
        (
            "Table III once more: lambda = 0.009 N and few levels",
            "table_3_fitted",
            table_3(results, FITTED),
            (),
        ),
        ("Untouched skin", "untouched", lambda_rows(lambdas, highest), ()),
    ):
        frame = pd.DataFrame(rows, dtype=object)
        page.csv(name, frame)
        page.section(title, frame, *charts)
    page.section("Maps", draw_maps(out, MAPPED, maps))
    page.section("What differs, and why")
    lines = conclusion(results)
    page.write(lines)
    return lines


def conclusion(results: Results) -> list[str]:
    """Differences of mean PSNR from tables III, as the text states and fitted, and of the times."""
    lines = []
    for method, text in (
        ("30", "as the text states it"),
        (FITTED, "with few levels and fitted lambda"),
    ):
        off = []
        for scene, paper in PAPER.items():
            for ratio, psnr in paper.by_ratio.items():
                ours_db = float(results.ours(scene, ratio, method).mean())
                off.append(ours_db - psnr.mean)
        lines.append(
            f"Mean PSNR of table III, {text}: {np.mean(off):+.1f} dB from the paper in the mean, "
            f"{min(off):+.1f} to {max(off):+.1f} dB, over {len(off)} figures."
        )
    slowest, fastest = results.speedups
    lines.append(
        f"A frame takes {slowest:.0f} to {fastest:.0f} times less time than in table IV."
    )
    return lines


def table_2(results: Results) -> Iterator[Row]:
    """Coefficients of both wavelets."""
    for scene, paper in PAPER.items():
        for basis in ("D2", "D4"):
            theirs: Counts = getattr(paper, basis.lower())
            counts = results.counts(scene, basis.lower())
            exact = results.counts(scene, f"{basis.lower()}_exact")
            yield {
                "scenario": results.name(scene),
                "basis": basis,
                **compared("mean", theirs.mean, float(counts.mean())),
                **compared("max", theirs.largest, int(counts.max())),
                "mean in contact": f"{counts[results.contact(scene)].mean():.1f}",
                "mean, rounding counted": f"{exact.mean():.1f}",
                "max, rounding counted": int(exact.max()),
            }


def compared(what: str, paper: float, ours: float) -> Row:
    """Three cells: the paper's figure, ours and the difference."""
    digits = 0 if isinstance(ours, int) else 1
    return {
        f"{what} paper": paper,
        f"{what} ours": f"{ours:.{digits}f}",
        f"{what} diff.": f"{ours - paper:+.{digits}f}",
    }


def psnr_row(
    results: Results,
    scene: str,
    paper: Psnr,
    ratio: int,
    method: str = "30",
    **named: Any,
) -> Row:
    """PSNR of our frames from M = N / ratio beside the paper's; ratio 1: of the noisy signal."""
    values = results.ours(scene, ratio, method)
    return {
        "scenario": results.name(scene),
        **named,
        **compared("mean", paper.mean, float(values.mean())),
        **compared("min", paper.low, float(values.min())),
        **compared("max", paper.high, float(values.max())),
        "mean in contact": f"{values[results.contact(scene)].mean():.1f}",
    }


def noisy(results: Results) -> Iterator[Row]:
    """The noisy signal."""
    for scene, paper in PAPER.items():
        yield psnr_row(results, scene, paper.noisy, 1)


def table_3(results: Results, method: str) -> Iterator[Row]:
    """PSNR by M."""
    for scene, paper in PAPER.items():
        for ratio, psnr in paper.by_ratio.items():
            yield psnr_row(results, scene, psnr, ratio, method, M=paper.n // ratio)


def table_4(results: Results) -> Iterator[Row]:
    """PSNR and time by iterations."""
    for scene, paper in PAPER.items():
        for k in ITERATIONS:
            ours_ms = results.times_ms[scene, str(k)]
            times = {
                "iterations": k,
                "time paper ms": paper.time_ms[k],
                "ours ms": f"{ours_ms:.2f}",
                "times faster": f"{paper.time_ms[k] / ours_ms:.0f}",
            }
            yield psnr_row(results, scene, paper.by_iterations[k], 3, str(k), **times)


def lambda_rows(lambdas: tuple[float, ...], highest: Highest) -> Iterator[Row]:
    """Highest PSNR of an untouched skin, and in brackets the upper ends of table III."""
    deviations = deviations_db(highest)
    for k, lambda_n in enumerate(lambdas):
        row: Row = {
            "lambda N": f"{lambda_n:.6g}",
            "few levels, off by dB": f"{deviations[k]:.1f}",
        }
        for (side, few, ratio), values in highest.items():
            levels = "few" if few and side == 40 else "all"
            end_db = np.mean(upper_ends(side, ratio))
            row[f"{side} {levels}, N/{ratio}"] = f"{values[k]:.1f} ({end_db:.1f})"
        yield row
