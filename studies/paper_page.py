"""The page of the study `paper-tables`: its tables, and what differs from the paper and why."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .paper_numbers import ITERATIONS, PAPER, RATIOS, Psnr
from .paper_reasons import reasons_text
from .paper_results import Highest, Results
from .report import markdown_table, write_csv, write_page

Row = dict[str, Any]


def write_paper_page(
    out: Path,
    results: Results,
    charts: Mapping[str, str],
    lambdas_n: Sequence[float],
    highest_db: Highest,
) -> None:
    """Write the tables as CSV, and the page.

    Parameters
    ----------
    out : Path
    results : Results
    charts : mapping of str to str
        Markdown of the charts maps, psnr_by_m, psnr_by_iterations, untouched, coefficients.
    lambdas_n : sequence of float
    highest_db : mapping
        Of an untouched skin, by (side, few_levels, ratio), in the order of lambdas_n.
    """
    tables = {
        "table_1": list(_steps(results)),
        "table_2": list(_counts(results)),
        "noisy": list(_noisy(results)),
        "table_3": list(_by_ratio(results, few=False)),
        "table_3_fitted": list(_by_ratio(results, few=True)),
        "table_4": list(_by_iterations(results)),
        "untouched": list(_untouched(lambdas_n, highest_db)),
    }
    shown = {
        name: f"{markdown_table(list(rows[0]), [list(row.values()) for row in rows])}\n\n"
        f"({write_csv(out, name, rows)})"
        for name, rows in tables.items()
    }
    reasons = _QUICK if results.quick else reasons_text(results, lambdas_n, highest_db)
    parts = [
        *("# The paper's tables again", _INTRODUCTION, *([_QUICK] if results.quick else [])),
        *("## Table I: steps", shown["table_1"]),
        *("## Table II: coefficients that are not zero", _COUNTED, shown["table_2"]),
        *("## The noisy signal, of tables III and IV", shown["noisy"]),
        *("## Table III: PSNR by M, 30 iterations", shown["table_3"], charts["psnr_by_m"]),
        *("## Table IV: iterations and time, M = N/3", _TIMED, shown["table_4"]),
        *(charts["psnr_by_iterations"], "## Maps", charts["maps"]),
        *("## Table III once more: lambda = 0.009 N and few levels", _FITTED),
        *(shown["table_3_fitted"], charts["untouched"], shown["untouched"]),
        *("## What differs, and why", reasons, charts["coefficients"]),
    ]
    write_page(out, "paper-tables", parts)


_INTRODUCTION = """Each table of the paper, its figure beside ours and the difference (ours less
the paper's). Ours are of the six scenes at their full length, noise and Phi as in the paper,
preset `paper`: FISTA with warm start, Haar at full depth, lambda = 0.1 on rows of +1 and -1,
which is 0.003125 N on orthonormal rows. The scenes are our own rebuilding of what the paper
describes in words, so that figures of a scene can differ where nothing is wrong; the last
section says what does and why. PSNR is in dB; `in contact`: over the frames alone in which some
taxel bears more than 0.01 N."""
_QUICK = """**A quick run: 200 frames around the first contact of each scene, and not the scenes.
It shows that the study runs; its differences from the paper mean nothing.**"""
_COUNTED = """Counted are coefficients above 1e-6 N, the rounding of float32 forces; `rounding
counted`: all that are not exactly 0 in float64. D2 has three levels on 40 x 40 and six on 64 x
64, D4 three and four, both with periodic edges."""
_TIMED = """Ours is the mean time of `Solver.solve`, over 1000 frames from the first contact on
(quick: 100), one process of one thread at a time; the paper's is of a GeForce GTX
480."""
_FITTED = """The preset takes the paper at its word. What its figures point to is another
lambda, and a Haar transform that ends where a side gets odd (last section). With these two, and
nothing else changed, table III is:"""


def _name(scene: str) -> str:
    return f"{PAPER[scene].title} ({PAPER[scene].n})"


def _steps(results: Results) -> Iterator[Row]:
    for scene, paper in PAPER.items():
        ours = len(results.scenes[scene]["contact"])
        yield {
            **{"scenario": _name(scene), "steps paper": paper.steps, "ours": ours},
            **{"difference": ours - paper.steps},
            "ours, in contact": int(results.contact(scene).sum()),
        }


def _counts(results: Results) -> Iterator[Row]:
    for scene, paper in PAPER.items():
        for basis, theirs in (("D2", paper.d2), ("D4", paper.d4)):
            key = basis.lower()
            counts = np.array(results.scenes[scene][key])
            exact = np.array(results.scenes[scene][f"{key}_exact"])
            yield {
                **{"scenario": _name(scene), "basis": basis},
                **_compared("mean", theirs.mean, float(counts.mean())),
                **_compared("max", theirs.largest, int(counts.max())),
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


def _psnr_cells(results: Results, scene: str, paper: Psnr, psnr: Sequence[float]) -> Row:
    values = np.array(psnr)
    return {
        **_compared("mean", paper.mean, float(values.mean())),
        **_compared("min", paper.low, float(values.min())),
        **_compared("max", paper.high, float(values.max())),
        "mean in contact": f"{values[results.contact(scene)].mean():.1f}",
    }


def _noisy(results: Results) -> Iterator[Row]:
    for scene, paper in PAPER.items():
        noisy = results.scenes[scene]["noisy_db"]
        yield {"scenario": _name(scene), **_psnr_cells(results, scene, paper.noisy, noisy)}


def _by_ratio(results: Results, few: bool) -> Iterator[Row]:
    for scene, paper in PAPER.items():
        for ratio in RATIOS:
            cells = _psnr_cells(
                *(results, scene, paper.by_ratio[ratio]), results.psnr[scene, ratio, 30, few]
            )
            yield {"scenario": _name(scene), "M": paper.n // ratio, **cells}


def _by_iterations(results: Results) -> Iterator[Row]:
    for scene, paper in PAPER.items():
        for k in ITERATIONS:
            cells = _psnr_cells(
                *(results, scene, paper.by_iterations[k]), results.psnr[scene, 3, k, False]
            )
            time_ms = results.times[scene, k]["mean_ms"]
            yield {
                **{"scenario": _name(scene), "iterations": k},
                **{"time paper ms": paper.time_ms[k], "ours ms": f"{time_ms:.2f}"},
                "times faster": f"{paper.time_ms[k] / time_ms:.0f}",
                **cells,
            }


def _untouched(lambdas_n: Sequence[float], highest_db: Highest) -> Iterator[Row]:
    """Highest PSNR of an untouched skin, and in brackets the upper ends of table III."""
    for k, lambda_n in enumerate(lambdas_n):
        row: Row = {"lambda N": f"{lambda_n:.6g}"}
        for (side, few, ratio), values in highest_db.items():
            ends = [p.by_ratio[ratio].high for p in PAPER.values() if p.n == side * side]
            levels = "few" if few and side == 40 else "all"
            row[f"{side} {levels}, N/{ratio}"] = f"{values[k]:.1f} ({np.mean(ends):.1f})"
        yield row
