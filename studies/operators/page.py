"""The page of the study `operators`: its tables and charts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from sparseskin.studies.report import PALETTE, Chart, draw_lines, fill_page, markdown, write_csv

#: Implementations of this project, and of a C compiler.
NUMPY, NUMBA, C = "numpy", "numba", "C"
#: Least times of an operator: column, style of its line, label.
FLOORS = (("flop_us", "--", "least: sums and products"), ("memory_us", ":", "least: bytes"))
LOGARITHMIC = {"xscale": "log", "yscale": "log", "xlabel": "taxels N"}


def write(
    out: Path, operators: pd.DataFrame, solvers: pd.DataFrame, left_out: Sequence[str], quick: bool
) -> None:
    """Write tables, charts and the page into a folder.

    Operators and solvers are rows of `time_operators` and of `time_solvers`; left_out, libraries
    that are not timed, and why.
    """
    fill_page(
        out,
        "operators",
        conclusion=conclusion(operators, solvers),
        quick=quick,
        left_out=left_out,
        operators_chart=_draw_operators(out, operators),
        operators=_operator_table(operators),
        solvers_chart=_draw_solvers(out, solvers),
        solvers=_solver_table(solvers),
        files=[write_csv(out, "operators", operators), write_csv(out, "iterations", solvers)],
    )


def conclusion(operators: pd.DataFrame, solvers: pd.DataFrame) -> list[str]:
    """Operators of numpy beside the least times, and frames of the default solver, at most N."""
    n = operators["n"].max()
    ours = operators[(operators["library"] == NUMPY) & (operators["n"] == n)]
    times = ours[["alone_us", "batch_us"]].min(axis=1) / ours[["flop_us", "memory_us"]].max(axis=1)
    lines = [
        f"Operators in numpy take {times.min():.1f} to {times.max():.1f} times what sums, products "
        f"and bytes cost at least, N = {n}."
    ]
    skin = solvers[(solvers["solver"] == "skin") & (solvers["n"] == solvers["n"].max())]
    for row in skin[skin["frame_ms"].notna()].itertuples():
        lines.append(
            f"Solver skin, {row.way}, N = {row.n}: {row.frame_ms:.2f} ms a frame, "
            f"{1000 / row.frame_ms:.0f} frames a second."
        )
    return lines


def _operator_table(rows: pd.DataFrame) -> str:
    ours = rows[rows["library"] == NUMPY].set_index(["operator", "n"])["alone_us"]
    least, alone = rows[["flop_us", "memory_us"]].max(axis=1), rows["alone_us"]
    table = {
        **{"operator": rows["operator"], "N": rows["n"], "library": rows["library"]},
        **{"µs a frame": alone, "µs in a batch": rows["batch_us"], "least, µs": least},
        "times the least": rows[["alone_us", "batch_us"]].min(axis=1) / least,
        "times numpy's": alone / ours.loc[[*zip(rows["operator"], rows["n"], strict=True)]].array,
    }
    digits = {"least, µs": ".2f", "times numpy's": ".2f"}
    digits |= dict.fromkeys(("µs a frame", "µs in a batch", "times the least"), ".1f")
    return markdown(pd.DataFrame(table), digits)


def _solver_table(rows: pd.DataFrame) -> str:
    floor = rows[rows["way"] == C].set_index(["solver", "n"])["iteration_us"]
    floor = floor.reindex([*zip(rows["solver"], rows["n"], strict=True)])
    table = {
        **{"solver": rows["solver"], "N": rows["n"], "way": rows["way"]},
        **{"ms a frame": rows["frame_ms"], "p99, ms": rows["p99_ms"]},
        **{"frames a second": 1000 / rows["frame_ms"], "iterations": rows["iterations"]},
        "µs an iteration": rows["iteration_us"],
        "times C's": rows["iteration_us"] / floor.array,
    }
    digits = {"frames a second": ".0f", "iterations": ".0f", "µs an iteration": ".1f"}
    digits |= {"ms a frame": ".3f", "p99, ms": ".3f", "times C's": ".2f"}
    return markdown(pd.DataFrame(table), digits)


def _draw_operators(out: Path, rows: pd.DataFrame) -> str:
    """Time over N, a panel an operator, with the floors."""
    operators, libraries = rows["operator"].unique(), rows["library"].unique().tolist()
    # In the same order in each panel.
    rows = rows.sort_values("library", key=lambda names: names.map(libraries.index), kind="stable")
    caption = "Time of each operator on one frame"
    with Chart(out, "operators", caption, len(operators), 3, size_in=(11, 7)) as chart:
        for axes, operator in zip(chart.panels, operators, strict=True):
            timed = rows[rows["operator"] == operator]
            draw_lines(axes, timed, "n", "alone_us", "library", libraries, markersize=5)
            ours = timed[timed["library"] == NUMPY]
            for column, line, label in FLOORS:
                axes.plot(ours["n"], ours[column], color=PALETTE[-1], linestyle=line, label=label)
            axes.set(title=operator, ylabel="µs a frame, alone", **LOGARITHMIC)
    return chart.markdown


def _draw_solvers(out: Path, rows: pd.DataFrame) -> str:
    """Time of an iteration over N, a panel a solver."""
    solvers = rows["solver"].unique()
    n, caption = len(solvers), "Time of an iteration of two solvers"
    size_in = (4.4 * n + 0.6, 4.2)
    with Chart(out, "iterations", caption, n, n, size_in=size_in, legend_columns=3) as chart:
        for axes, solver in zip(chart.panels, solvers, strict=True):
            timed = rows[rows["solver"] == solver]
            draw_lines(axes, timed, "n", "iteration_us", "way", (NUMPY, NUMBA, C))
            axes.set(title=solver, ylabel="µs an iteration", **LOGARITHMIC)
    return chart.markdown
