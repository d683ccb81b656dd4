"""The page of study `paper-tables`: its tables, its charts, and why figures differ."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import pandas as pd

from sparseskin.studies.report import (
    LINES,
    MARKERS,
    PALETTE,
    Chart,
    fill_page,
    series_style,
    write_csv,
)
from sparseskin.studies.scene_frames import scene_of

from .numbers import ITERATIONS, PAPER, RATIOS, Counts, Psnr

Row = dict[str, Any]
SHOWN_FRAMES = 300
#: Scene of the paper's figure of forces, N/3, 20 iterations.
MAPPED = "drag_wrench_64"
#: Title, frame, maps (true, noisy, reconstructed), PSNR (noisy, reconstructed) in dB.
Maps: TypeAlias = Sequence[tuple[str, int, Any, Sequence[float]]]
#: Highest PSNR of an untouched skin in dB, by (side, few_levels, ratio), for each lambda.
Highest: TypeAlias = Mapping[tuple[int, bool, int], Sequence[float]]


@dataclass(frozen=True)
class Results:
    """Figures of the study.

    Attributes
    ----------
    quick : bool
        True if they are of the frames around the first contact alone.
    scenes : dict
        By scene: figures of `scene_figures`.
    psnr : dict
        By (scene, ratio, iterations, few_levels): PSNR of each frame in dB. With few levels
        lambda is the fitted one, else the one of preset `paper`.
    times : dict
        By (scene, iterations): figures of `solve_times`.
    """

    quick: bool
    scenes: dict[str, dict[str, Any]]
    psnr: dict[tuple[str, int, int, bool], list[float]]
    times: dict[tuple[str, int], dict[str, float]]

    def contact(self, scene: str) -> npt.NDArray[np.bool_]:
        """True for each frame of a scene that is in contact."""
        return np.array(self.scenes[scene]["contact"], dtype=np.bool_)

    def ours(
        self, scene: str, ratio: int, iterations: int = 30, few: bool = False
    ) -> npt.NDArray[np.float64]:
        """PSNR of each frame in dB; ratio 1: of the noisy signal."""
        if ratio == 1:
            return np.array(self.scenes[scene]["noisy_db"])
        return np.array(self.psnr[scene, ratio, iterations, few])

    def counts(self, scene: str, key: str) -> npt.NDArray[np.int_]:
        """Number of coefficients in each frame: d2, d4, d2_exact, d4_exact."""
        return np.array(self.scenes[scene][key])

    def chosen_frames(self, scene: str) -> dict[str, int]:
        """Numbers of the contact frames of median and of least PSNR, from N/3 by 20 iterations."""
        psnr, contact = self.ours(scene, 3, 20), np.flatnonzero(self.contact(scene))
        by_psnr = contact[np.argsort(psnr[contact])] + self.scenes[scene]["first"]
        return {"representative": int(by_psnr[len(by_psnr) // 2]), "worst": int(by_psnr[0])}


def write(
    out: Path, results: Results, lambdas_n: Sequence[float], highest_db: Highest, maps: Maps
) -> None:
    """Write the tables as CSV, the charts and the page; `highest_db` in the order of lambdas_n."""
    tables: dict[str, Iterable[Row]] = {
        "table_1": (_steps(results, scene) for scene in PAPER),
        "table_2": (_counts(results, scene, basis) for scene in PAPER for basis in ("D2", "D4")),
        "noisy": (_psnr(results, scene, paper.noisy, {}, 1) for scene, paper in PAPER.items()),
        "table_3": _by_ratio(results, few=False),
        "table_3_fitted": _by_ratio(results, few=True),
        "table_4": (_time(results, scene, k) for scene in PAPER for k in ITERATIONS),
        "untouched": _untouched(lambdas_n, highest_db),
    }
    frames = {name: pd.DataFrame(rows, dtype=object) for name, rows in tables.items()}
    fill_page(
        out,
        "paper-tables",
        conclusion=conclusion(results),
        quick=results.quick,
        csv={name: write_csv(out, name, frame) for name, frame in frames.items()},
        **frames,
        maps=_draw_maps(out, maps),
        **_draw_sequences(out, results),
        untouched_chart=_draw_untouched(out, lambdas_n, highest_db),
        coefficients=_draw_coefficients(out, results),
        **_reasons(results, lambdas_n, highest_db),
    )


def conclusion(results: Results) -> list[str]:
    """Differences of mean PSNR from tables III, as the text states and fitted, and of the times."""
    lines = []
    for few, text in (
        (False, "as the text states it"),
        (True, "with few levels and fitted lambda"),
    ):
        off = [
            float(results.ours(scene, ratio, few=few).mean()) - psnr.mean
            for scene, paper in PAPER.items()
            for ratio, psnr in paper.by_ratio.items()
        ]
        lines.append(
            f"Mean PSNR of table III, {text}: {np.mean(off):+.1f} dB from the paper in the mean, "
            f"{min(off):+.1f} to {max(off):+.1f} dB, over {len(off)} figures."
        )
    quotients = [
        PAPER[scene].time_ms[k] / results.times[scene, k]["mean_ms"]
        for scene in PAPER
        for k in ITERATIONS
    ]
    lines.append(
        f"A frame takes {min(quotients):.0f} to {max(quotients):.0f} times less time than in "
        "table IV."
    )
    return lines


def _name(scene: str) -> str:
    return f"{PAPER[scene].title} ({PAPER[scene].n})"


def _steps(results: Results, scene: str) -> Row:
    steps, contact = PAPER[scene].steps, results.contact(scene)
    row = {"scenario": _name(scene), "steps paper": steps, "ours": len(contact)}
    return {**row, "difference": len(contact) - steps, "ours, in contact": int(contact.sum())}


def _counts(results: Results, scene: str, basis: str) -> Row:
    key = basis.lower()
    paper: Counts = getattr(PAPER[scene], key)
    counts, exact = results.counts(scene, key), results.counts(scene, f"{key}_exact")
    return {
        **{"scenario": _name(scene), "basis": basis},
        **_compared("mean", paper.mean, float(counts.mean())),
        **_compared("max", paper.largest, int(counts.max())),
        "mean in contact": f"{counts[results.contact(scene)].mean():.1f}",
        "mean, rounding counted": f"{exact.mean():.1f}",
        "max, rounding counted": int(exact.max()),
    }


def _compared(what: str, paper: float, ours: float) -> Row:
    """Three cells: the paper's figure, ours and the difference."""
    digits = 0 if isinstance(ours, int) else 1
    return {
        f"{what} paper": paper,
        f"{what} ours": f"{ours:.{digits}f}",
        f"{what} diff.": f"{ours - paper:+.{digits}f}",
    }


def _psnr(
    results: Results,
    scene: str,
    paper: Psnr,
    named: Row,
    ratio: int,
    iterations: int = 30,
    few: bool = False,
) -> Row:
    """PSNR of our frames from M = N / ratio beside the paper's; ratio 1: of the noisy signal."""
    values = results.ours(scene, ratio, iterations, few)
    return {
        **{"scenario": _name(scene), **named},
        **_compared("mean", paper.mean, float(values.mean())),
        **_compared("min", paper.low, float(values.min())),
        **_compared("max", paper.high, float(values.max())),
        "mean in contact": f"{values[results.contact(scene)].mean():.1f}",
    }


def _by_ratio(results: Results, few: bool) -> Iterator[Row]:
    for scene, paper in PAPER.items():
        for ratio, psnr in paper.by_ratio.items():
            yield _psnr(results, scene, psnr, {"M": paper.n // ratio}, ratio, few=few)


def _time(results: Results, scene: str, k: int) -> Row:
    paper, ours_ms = PAPER[scene], results.times[scene, k]["mean_ms"]
    times = {"time paper ms": paper.time_ms[k], "ours ms": f"{ours_ms:.2f}"}
    named = {"iterations": k, **times, "times faster": f"{paper.time_ms[k] / ours_ms:.0f}"}
    return _psnr(results, scene, paper.by_iterations[k], named, 3, k)


def _untouched(lambdas_n: Sequence[float], highest_db: Highest) -> Iterator[Row]:
    """Highest PSNR of an untouched skin, and in brackets the upper ends of table III."""
    for k, lambda_n in enumerate(lambdas_n):
        row: Row = {"lambda N": f"{lambda_n:.6g}"}
        for (side, few, ratio), values in highest_db.items():
            levels = "few" if few and side == 40 else "all"
            end_db = np.mean(_upper_ends(side, ratio))
            row[f"{side} {levels}, N/{ratio}"] = f"{values[k]:.1f} ({end_db:.1f})"
        yield row


def _upper_ends(side: int, ratio: int) -> list[float]:
    """Upper ends of the ranges in table III, dB, of the scenarios of one size."""
    return [paper.by_ratio[ratio].high for paper in PAPER.values() if paper.n == side * side]


def deviations_db(highest_db: Highest, few_levels: bool) -> list[float]:
    """Deviation of an untouched skin's PSNR from the upper ends of the ranges in table III.

    Returns
    -------
    list of float
        For each lambda: root mean square in dB over both sizes and three M. On 64 x 64 there is
        but one Haar, of six levels.
    """
    kinds = [(40, few_levels), (64, True)]
    off_db = [
        np.array(highest_db[side, few, ratio]) - np.mean(_upper_ends(side, ratio))
        for side, few in kinds
        for ratio in RATIOS
    ]
    return [float(one) for one in np.sqrt(np.mean(np.square(off_db), axis=0))]


def _reasons(results: Results, lambdas_n: Sequence[float], highest_db: Highest) -> dict[str, Any]:
    """Figures of the section on differences from the paper and their causes."""
    few, every = (deviations_db(highest_db, few_levels=few) for few in (True, False))
    best, best_every = int(np.argmin(few)), int(np.argmin(every))
    spreads_db = [
        np.ptp([results.ours(scene, 3, iterations).mean() for iterations in ITERATIONS])
        for scene in PAPER
    ]
    speedups = [PAPER[scene].time_ms[k] / of["mean_ms"] for (scene, k), of in results.times.items()]
    return {
        **{"paper": PAPER, "results": results, "ratios": RATIOS},
        **{"lambda_n": lambdas_n[best], "preset_lambda_n": lambdas_n[0]},
        **{"best_db": few[best], "preset_db": few[0]},
        **{"lambda_every_n": lambdas_n[best_every], "best_every_db": every[best_every]},
        **{"spread_db": max(spreads_db), "speedups": speedups},
    }


def _draw_maps(out: Path, maps: Maps) -> str:
    """True forces, taxels and reconstructed forces, a row a frame."""
    caption = "Forces of DRAG WRENCH 64 x 64, reconstructed from 1365 numbers, 20 iterations."
    n_rows = len(maps)
    size_in = (9.0, 2.9 * n_rows + 0.4)
    with Chart(out, "maps", caption, 3 * n_rows, 3, size_in=size_in, legend_columns=0) as chart:
        for k, (title, frame, images, (noisy_db, ours_db)) in enumerate(maps):
            row = chart.panels[3 * k : 3 * k + 3]
            top = float(np.max(images[0]))
            notes = ("true", f"noisy, {noisy_db:.1f} dB", f"reconstructed, {ours_db:.1f} dB")
            for axes, image, note in zip(row, images, notes, strict=True):
                drawn = axes.imshow(image, vmin=0, vmax=top, cmap="viridis", origin="lower")
                axes.set(title=note, xlabel="column")
                axes.grid(False)
            row[0].set_ylabel(f"{title}, {frame * scene_of(MAPPED).dt_ns * 1e-6:.1f} ms\nrow")
            chart.figure.colorbar(drawn, ax=row, label="force in N", shrink=0.9)
    return chart.markdown


def _draw_sequences(out: Path, results: Results) -> dict[str, Any]:
    """PSNR over time, by M in DRAG WRENCH and by iterations in LIFT BOX, 64 x 64."""
    by_m = {f"M = N/{ratio}": (ratio, 30) for ratio in RATIOS}
    by_k = {f"{k} iterations": (3, k) for k in ITERATIONS}
    charts = {}
    for name, scene, settings in (
        ("psnr_by_m", "drag_wrench_64", by_m),
        ("psnr_by_iterations", "lift_box_64", by_k),
    ):
        contact, figures = results.contact(scene), results.scenes[scene]
        begins = {
            "representative": _longest_contact(contact),
            "first contact": max(0, int(np.argmax(contact)) - 50),
        }
        series = {label: results.ours(scene, *how) for label, how in settings.items()}
        series["noisy"] = results.ours(scene, 1)
        caption = f"PSNR over time, {PAPER[scene].title} 64 x 64, preset paper"
        with Chart(out, name, caption, len(begins), len(begins), size_in=(9.0, 4.2)) as chart:
            for axes, (title, begin) in zip(chart.panels, begins.items(), strict=True):
                part = slice(begin, min(begin + SHOWN_FRAMES, len(contact)))
                frames = np.arange(part.start, part.stop) + figures["first"]
                for k, (label, values) in enumerate(series.items()):
                    k = -1 if label == "noisy" else k
                    axes.plot(
                        *(frames * scene_of(scene).dt_ns * 1e-6, values[part]),
                        label=label,
                        color=PALETTE[k],
                        linestyle=LINES[k],
                        marker=MARKERS[k],
                        markersize=4,
                        markevery=(k * 5 % 30, max(1, len(frames) // 8)),
                    )
                axes.set(title=title, xlabel="time in the scene in ms", ylabel="PSNR in dB")
        charts[name] = chart.markdown
    return charts


def _longest_contact(contact: npt.NDArray[np.bool_]) -> int:
    """First of the middle frames of the longest contact: forces change slowly there."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], contact, [False]])))
    begins, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - begins))
    middle = int(begins[longest] + ends[longest]) // 2
    return max(0, middle - SHOWN_FRAMES // 2)


def _draw_untouched(out: Path, lambdas_n: Sequence[float], highest_db: Highest) -> str:
    """Highest PSNR of an untouched skin over lambda, with the range ends of table III."""
    titles = {
        (40, False): "40 x 40, all levels",
        (40, True): "40 x 40, three levels",
        (64, True): "64 x 64, six levels",
    }
    caption = (
        "Highest PSNR of an untouched skin over lambda (30 iterations; above 72 dB cut off); "
        "shaded: the upper ends of the ranges in the paper's table III"
    )
    n = len(titles)
    with Chart(
        out, "untouched", caption, n, n, size_in=(10.0, 4.4), legend_columns=3, sharey=True
    ) as chart:
        for axes, (kind, title) in zip(chart.panels, titles.items(), strict=True):
            for k, ratio in enumerate(RATIOS):
                axes.plot(
                    *(lambdas_n, np.clip(highest_db[(*kind, ratio)], 0, 72)),
                    label=f"ours, M = N/{ratio}",
                    **series_style(k),
                )
                ends = _upper_ends(kind[0], ratio)
                band: Row = {"color": PALETTE[k], "alpha": 0.25, "label": f"paper, M = N/{ratio}"}
                axes.axhspan(min(ends), max(ends), **band)
            axes.set(xscale="log", title=title, xlabel="lambda in mN")
            axes.set_xticks(lambdas_n[::2], [f"{x * 1e3:.1f}" for x in lambdas_n[::2]])
            axes.minorticks_off()
            axes.set_ylim(50, 72)
        chart.panels[0].set_ylabel("highest PSNR in dB")
    return chart.markdown


def _draw_coefficients(out: Path, results: Results) -> str:
    """PSNR from N/3 over the number of D2 coefficients; means of the paper and of ours."""
    caption = (
        "PSNR of our frames in contact over the number of coefficients there are to find; "
        "marks: means over all frames of a scenario, filled as the paper reports, open ours"
    )
    titles = list(dict.fromkeys(paper.title for paper in PAPER.values()))
    with Chart(out, "coefficients", caption, 2, 2, size_in=(9.0, 4.6), legend_columns=3) as chart:
        for axes, n in zip(chart.panels, (1600, 4096), strict=True):
            of_size = {scene: paper for scene, paper in PAPER.items() if paper.n == n}
            # A tenth of the frames shows as much, in a file that can be opened.
            every = 1 if results.quick else 10
            frames = {scene: np.flatnonzero(results.contact(scene))[::every] for scene in of_size}
            counts = [results.counts(scene, "d2")[chosen] for scene, chosen in frames.items()]
            psnr = [results.ours(scene, 3)[chosen] for scene, chosen in frames.items()]
            dots: Row = {"s": 4, "alpha": 0.15, "color": "0.5", "label": "our frames"}
            axes.scatter(np.concatenate(counts), np.concatenate(psnr), **dots)
            for scene, paper in of_size.items():
                k, ours = titles.index(paper.title), results.ours(scene, 3).mean()
                style: Row = {"color": PALETTE[k], "marker": MARKERS[k], "linestyle": ""}
                style |= {"markersize": 8}
                theirs = (paper.d2.mean, paper.by_ratio[3].mean)
                axes.plot(*theirs, label=f"paper, {paper.title}", **style)
                style |= {"markerfacecolor": "white", "label": f"ours, {paper.title}"}
                axes.plot(np.mean(results.counts(scene, "d2")), ours, **style)
            axes.set(title=f"N = {n}, M = N/3, 30 iterations", ylabel="PSNR in dB")
            axes.set_xlabel("D2 coefficients of the true forces")
    return chart.markdown
