"""Charts that the parts of the stability study draw alike."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sparseskin.studies.report import LINES, MARKERS, PALETTE, new_figure
from sparseskin.studies.solvers import SUM_SOLVERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Where curves are cut off: what lies below has failed, however deep; what lies above is all good.
FLOOR_DB, CEILING_DB = 10.0, 70.0
#: Readings of all taxels, as a line beside the solvers'.
READINGS: dict[str, Any] = {"color": "#555555", "linewidth": 2.2, "alpha": 0.6, "zorder": 1}


def panels(
    n_panels: int, n_columns: int, width_in: float = 3.1, height_in: float = 2.6
) -> tuple[Figure, list[Axes]]:
    """A figure with so many panels in rows of so many, and room for a legend below."""
    n_rows = -(-n_panels // n_columns)
    figure = new_figure(width_in * n_columns, height_in * n_rows + 0.6)
    axes = [figure.add_subplot(n_rows, n_columns, k + 1) for k in range(n_panels)]
    return figure, axes


def solver_style(solver: str) -> dict[str, Any]:
    """Colour, marker and line of a solver, the same in each chart."""
    k = list(SUM_SOLVERS).index(solver)
    return {
        "color": PALETTE[k % len(PALETTE)],
        "marker": MARKERS[k % len(MARKERS)],
        "linestyle": LINES[k % len(LINES)],
        "markersize": 3.5,
        "label": solver,
    }


def draw_solvers(
    axes: Axes,
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    noisy: tuple[Sequence[float], Sequence[float]],
    floor_db: float = FLOOR_DB,
) -> None:
    """One line of decibels for each solver and one for the readings, drawn within the limits."""

    def within(ys: Sequence[float]) -> list[float]:
        return [min(max(y, floor_db), CEILING_DB) for y in ys]

    axes.plot(noisy[0], within(noisy[1]), **READINGS, label="readings of all taxels")
    for solver, (xs, ys) in curves.items():
        axes.plot(xs, within(ys), **solver_style(solver))


def label_outer(axes: Sequence[Axes], n_columns: int, x_label: str, y_label: str) -> None:
    """Name the axes at the left, and below each panel that has none under it."""
    for k, one in enumerate(axes):
        if k % n_columns == 0:
            one.set_ylabel(y_label)
        if k + n_columns >= len(axes):
            one.set_xlabel(x_label)


def by_solver(
    rows: Iterable[Mapping[str, Any]], x: str, y: str
) -> dict[str, tuple[list[float], list[float]]]:
    """Curves of points with their figures, as {solver: (xs, ys)}, in the order of the rows."""
    curves: dict[str, tuple[list[float], list[float]]] = {}
    for row in rows:
        xs, ys = curves.setdefault(row["solver"], ([], []))
        xs.append(row[x])
        ys.append(row[y])
    return curves
