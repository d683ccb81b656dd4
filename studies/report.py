"""What a study leaves: CSV, Markdown and charts, all in one style."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .points import StudyError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Okabe and Ito's colours, which the colour-blind can tell apart; black last, for references.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")
#: In grey print and for every eye: markers and line styles differ where colours do.
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
LINES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)))
PNG_DPI = 150
_STYLE: Any = {
    "figure.constrained_layout.use": True,
    "figure.facecolor": "white",
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "svg.hashsalt": "sparseskin",  # without it, the same chart is another file each time
}


def series_style(k: int) -> dict[str, Any]:
    """How the k-th series of a chart is drawn: 49 that differ in colour or mark, 7 in both."""
    turn, place = divmod(k, 7)
    return {
        "color": PALETTE[place],
        "marker": MARKERS[(place + 3 * turn) % 7],
        "linestyle": LINES[(place + turn) % 7],
        "markerfacecolor": "white" if turn % 2 else PALETTE[place],
    }


def new_figure(width_in: float = 7.5, height_in: float = 4.5) -> Figure:
    """An empty figure of a width and height in inches, to be filled within `chart_style`."""
    # Imported here: the charts alone need it, not what the workers compute.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


@contextmanager
def chart_style() -> Iterator[None]:
    """All charts that are made within look alike."""
    import matplotlib

    with matplotlib.rc_context(_STYLE):
        yield


def legend_outside(figure: Figure, n_columns: int = 4) -> None:
    """One legend for all axes of a figure, below them; the same label is shown once."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=n_columns
    )


def save_figure(figure: Figure, out: Path, name: str, caption: str) -> str:
    """Save a figure as `name.png` and `name.svg`; the Markdown that shows it.

    Raises
    ------
    StudyError
        If it cannot be written.
    """
    try:
        with chart_style():
            figure.savefig(out / f"{name}.png", dpi=PNG_DPI)
            figure.savefig(out / f"{name}.svg", metadata={"Date": None})
    except OSError as error:
        raise StudyError(f"{out / name}: {error.strerror}") from error
    return f"![{caption}]({name}.png)\n\n*{caption}* ([SVG]({name}.svg))"


def write_csv(out: Path, name: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Write rows, each with the same keys, to `name.csv`; the Markdown that links it.

    Raises
    ------
    StudyError
        If it cannot be written.
    """
    path = out / f"{name}.csv"
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else [])
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror}") from error
    return f"[{path.name}]({path.name})"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; numbers are to be given as the text that is to be read."""
    lines = [list(header), ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def write_page(out: Path, name: str, parts: Iterable[str]) -> Path:
    """Write the study's page `name.md`, its parts set apart by blank lines.

    Raises
    ------
    StudyError
        If it cannot be written.
    """
    path = out / f"{name}.md"
    try:
        path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror}") from error
    return path
