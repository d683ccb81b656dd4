"""The page of the study `operators`: its tables and charts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from .operators_points import NUMBA, NUMPY, OPERATORS, C
from .report import (
    PALETTE,
    chart_style,
    legend_outside,
    markdown_table,
    new_figure,
    save_figure,
    series_style,
    write_csv,
    write_page,
)

Row = dict[str, Any]

_FLOORS = """The least an operator could take on this machine, measured in the same process: its
sums and products at the speed of a float32 matrix product of 256 x 256 (every one of them half of
a fused multiply-add), and its input and output, read and written once, at the speed of a copy of N
numbers. Neither counts the permutations, which no copy has. Medians of short windows of calls, so
that a busy machine disturbs few of them."""

_PEERS = """PyWavelets' and PyLops' wavelets are their own, and where a side cannot be halved they
pad, so they do a little more than ours. PyLops' Phi is made of its Restriction and MatrixMult;
scipy's matrices are the very same operators in compressed rows."""

_SOLVERS = """Frames of a square that slides over the skin, M = N/3: `skin` as it is preset, FISTA
with the paper's 20 iterations; p99 is of the time that a frame had a core. An iteration is timed by
itself too, and beside it the same loops in C (-O3 -march=native -ffast-math), which carries nothing
from frame to frame and checks nothing."""


def draw_operators(out: Path, rows: Sequence[Row]) -> str:
    """Time over N, a panel an operator, with the floors."""
    with chart_style():
        figure = new_figure(11, 7)
        axes = figure.subplots(2, 3, squeeze=False)
        libraries = list(dict.fromkeys(row["library"] for row in rows))
        for axis, operator in zip(axes.flat, OPERATORS, strict=False):
            mine = [row for row in rows if row["operator"] == operator]
            for k, library in enumerate(libraries):
                points = [(r["n"], r["alone_us"]) for r in mine if r["library"] == library]
                if points:
                    style = series_style(k)
                    axis.plot(*zip(*points, strict=True), label=library, markersize=5, **style)
            ours = [row for row in mine if row["library"] == NUMPY]
            for key, line, label in (
                ("flop_us", "--", "least: sums and products"),
                ("memory_us", ":", "least: bytes"),
            ):
                axis.plot(
                    [row["n"] for row in ours],
                    [row[key] for row in ours],
                    **{"color": PALETTE[-1], "linestyle": line, "label": label},
                )
            axis.set_title(operator)
            axis.set_xscale("log")
            axis.set_yscale("log")
            axis.set_xlabel("taxels N")
            axis.set_ylabel("µs a frame, alone")
        for axis in axes.flat[len(OPERATORS) :]:
            axis.set_axis_off()
        legend_outside(figure, 4)
        return save_figure(figure, out, "operators", "Time of each operator on one frame")


def draw_solvers(out: Path, rows: Sequence[Row]) -> str:
    """Time of an iteration over N, a panel a solver."""
    solvers = list(dict.fromkeys(row["solver"] for row in rows))
    with chart_style():
        figure = new_figure(4.4 * len(solvers) + 0.6, 4.2)
        for axis, solver in zip(
            figure.subplots(1, len(solvers), squeeze=False)[0], solvers, strict=True
        ):
            for k, way in enumerate((NUMPY, NUMBA, C)):
                points = [
                    (row["n"], row["iteration_us"])
                    for row in rows
                    if row["solver"] == solver and row["way"] == way
                ]
                if points:
                    axis.plot(*zip(*points, strict=True), label=way, **series_style(k))
            axis.set_title(solver)
            axis.set_xscale("log")
            axis.set_yscale("log")
            axis.set_xlabel("taxels N")
            axis.set_ylabel("µs an iteration")
        legend_outside(figure, 3)
        return save_figure(figure, out, "iterations", "Time of an iteration of two solvers")


def write_operators_page(
    out: Path,
    rows: Sequence[Row],
    solver_rows: Sequence[Row],
    charts: Sequence[str],
    left_out: Sequence[str],
    quick: bool,
) -> None:
    """Write `operators.md` and the CSV files."""
    parts = ["# Operators: what they take, and the least they could"]
    if quick:
        parts.append("Quick: small sizes, few windows. It shows that the study runs.")
    if left_out:
        parts.append("\n".join(f"- **Left out:** {line}" for line in left_out))
    parts += [
        *("## Operators", _FLOORS, _PEERS, charts[0]),
        markdown_table(
            (
                *("operator", "N", "library", "µs a frame", "µs in a batch", "least, µs"),
                *("times the least", "times numpy's"),
            ),
            _operator_lines(rows),
        ),
        *("## Solvers", _SOLVERS, charts[1]),
        markdown_table(
            (
                *("solver", "N", "way", "ms a frame", "p99, ms", "frames a second"),
                *("iterations", "µs an iteration", "times C's"),
            ),
            _solver_lines(solver_rows),
        ),
        f"All figures: {write_csv(out, 'operators', rows)}, "
        f"{write_csv(out, 'iterations', solver_rows)}",
    ]
    write_page(out, "operators", parts)


def _operator_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    ours = {(r["operator"], r["n"]): r["alone_us"] for r in rows if r["library"] == NUMPY}
    for row in rows:
        least = max(row["flop_us"], row["memory_us"])
        alone, batch = row["alone_us"], row["batch_us"]
        best = min(alone, batch or alone)
        yield [
            *(row["operator"], str(row["n"]), row["library"], f"{alone:.1f}"),
            *("" if batch is None else f"{batch:.1f}", f"{least:.2f}", f"{best / least:.1f}"),
            f"{alone / ours[row['operator'], row['n']]:.2f}",
        ]


def _solver_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    floor = {(r["solver"], r["n"]): r["iteration_us"] for r in rows if r["way"] == C}
    for row in rows:
        least = floor.get((row["solver"], row["n"]))
        ms = row["frame_ms"]
        yield [
            *(row["solver"], str(row["n"]), row["way"]),
            *(("", "", "") if ms is None else (f"{ms:.3f}", f"{row['p99_ms']:.3f}")),
            *(() if ms is None else (f"{1000 / ms:.0f}",)),
            "" if row["iterations"] is None else f"{row['iterations']:.0f}",
            f"{row['iteration_us']:.1f}",
            "" if least is None else f"{row['iteration_us'] / least:.2f}",
        ]
