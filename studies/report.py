"""Output of a study: CSV tables, charts and a Markdown page filled from a template."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self, TypeAlias

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from .points import StudyError

Rows: TypeAlias = "pd.DataFrame | Sequence[Mapping[str, Any]]"

#: Okabe and Ito's colours, distinguishable for colour-blind readers; black last, for references.
PALETTE = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#F0E442",
    "#000000",
)
#: Markers and line styles differ where colours do: charts are readable in grey print.
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
LINES = (
    "-",
    "--",
    "-.",
    ":",
    (0, (5, 1)),
    (0, (3, 1, 1, 1, 1, 1)),
    (0, (1, 1)),
    (0, (8, 2)),
)
PNG_DPI = 150
QUICK = "**A quick run: few frames and points. It shows that the study runs, and little else.**"
_STYLE: Any = {
    "figure.facecolor": "white",
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    # Without it, the same chart is another file each time.
    "svg.hashsalt": "sparseskin",
}


def series_style(k: int) -> dict[str, Any]:
    """Style of the k-th series of a chart: 49 that differ in colour or mark, 7 in both."""
    turn, place = divmod(k, 7)
    return {
        "color": PALETTE[place],
        "marker": MARKERS[(place + 3 * turn) % 7],
        "linestyle": LINES[(place + turn) % 7],
        "markerfacecolor": "white" if turn % 2 else PALETTE[place],
    }


class Chart:
    """A figure of panels in the common style, saved as it is left: `with Chart(...) as chart:`, as
    `name.png` and `name.svg` in `out`; StudyError if they cannot be written.

    `n_panels`, `n_columns`: panels, row by row; `size_in`: inches; `legend_columns`: of the legend
    below them (0: none); `subplots`: as `Figure.subplots` takes them. `markdown` shows it on a
    page.
    """

    def __init__(
        self,
        out: Path,
        name: str,
        caption: str,
        n_panels: int = 1,
        n_columns: int = 1,
        *,
        size_in: tuple[float, float] = (7.5, 4.5),
        legend_columns: int = 4,
        **subplots: Any,
    ) -> None:
        self._path = out / name
        self.name = name
        self.caption = caption
        self._n_columns = n_columns
        self._legend_columns = legend_columns
        self.markdown = f"![{caption}]({name}.png)\n\n*{caption}* ([SVG]({name}.svg))"
        self._style = matplotlib.rc_context(_STYLE)
        with matplotlib.rc_context(_STYLE):
            self.figure = Figure(figsize=size_in, layout="constrained")
            FigureCanvasAgg(self.figure)
            n_rows = -(-n_panels // n_columns)
            grid = list(
                self.figure.subplots(n_rows, n_columns, squeeze=False, **subplots).flat
            )
        self.panels: list[Axes] = grid[:n_panels]
        for unused in grid[n_panels:]:
            unused.set_axis_off()

    def __enter__(self) -> Self:
        self._style.__enter__()
        return self

    def __exit__(self, kind: Any, error: Any, traceback: Any) -> None:
        try:
            if error is None:
                self._save()
        finally:
            self._style.__exit__(kind, error, traceback)

    def label(self, x_label: str, y_label: str) -> None:
        """Label the y axes of the left column and the x axes with no panel below them."""
        for k, axes in enumerate(self.panels):
            if k % self._n_columns == 0:
                axes.set_ylabel(y_label)
            if k + self._n_columns >= len(self.panels):
                axes.set_xlabel(x_label)
                axes.tick_params(labelbottom=True)

    def _save(self) -> None:
        if self._legend_columns:
            entries: dict[str, Any] = {}
            for axes in self.figure.axes:
                handles, labels = axes.get_legend_handles_labels()
                for handle, label in zip(handles, labels, strict=True):
                    entries.setdefault(label, handle)
            self.figure.legend(
                list(entries.values()),
                list(entries),
                loc="outside lower center",
                ncols=self._legend_columns,
            )
        # The layout takes longer than the drawing, and each file would have four of its own; the
        # second one is nearer to the margins than the first.
        engine = self.figure.get_layout_engine()
        assert engine is not None
        for _ in range(2):
            engine.execute(self.figure)
        self.figure.set_layout_engine(None)
        try:
            self.figure.savefig(f"{self._path}.png", dpi=PNG_DPI)
            self.figure.savefig(f"{self._path}.svg", metadata={"Date": None})
        except OSError as error:
            raise StudyError(f"{self._path}: {error.strerror}") from error


def draw_lines(
    axes: Axes,
    frame: pd.DataFrame,
    x: str,
    y: str,
    by: str,
    order: Sequence[Any] = (),
    **style: Any,
) -> None:
    """Draw a line over column x for each value of column `by`, labelled by it; styles are those of
    its place in `order`, by default as they come, with the changes `style`.
    """
    labels = list(order) or list(frame[by].unique())
    for label, along in frame.groupby(by, sort=False):
        line = series_style(labels.index(label)) | style
        axes.plot(along[x], along[y], label=str(label), **line)


def markdown(frame: pd.DataFrame, formats: Mapping[str, str] | str = "") -> str:
    """A data frame as a Markdown table, missing values empty. `formats`: of the numbers of each
    column, or of all, as `format` takes it.
    """

    def cell(value: Any, spec: str) -> str:
        if value is None or value is pd.NA or value != value:
            return ""
        return str(value) if isinstance(value, str) or not spec else format(value, spec)

    spec_of = [
        formats if isinstance(formats, str) else formats.get(column, "")
        for column in frame
    ]
    lines = [list(map(str, frame)), ["---"] * len(spec_of)]
    # Of objects, so that whole numbers stay such in a row with others.
    for row in frame.astype(object).itertuples(index=False):
        lines.append(list(map(cell, row, spec_of)))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def cells(frame: pd.DataFrame, text: str) -> list[str]:
    """Format each row of a frame, as in `cells(frame, "{mean_db:.1f} ({min_db:.1f})")`."""
    return [text.format(**row) for row in frame.to_dict("records")]


class Page:
    """The page of a study: sections of text, tables and charts.

    `notes`: Markdown with the text of each section under its title, those of the page first, in
    which {name} stands for a value that the section is given; `quick`: True for a page that states
    that its figures are those of a quick run; `command` that computes it (default: the study).
    """

    def __init__(
        self, out: Path, name: str, notes: Path, quick: bool, command: str = ""
    ) -> None:
        self.out = out
        self._name = name
        self._quick = quick
        self._command = command or f"study {name}{' --quick' if quick else ''}"
        text = notes.read_text(encoding="utf-8")
        head, *parts = text.removeprefix("# ").split("\n## ")
        self._title, _, opening = head.partition("\n")
        self._notes = dict(part.split("\n", 1) for part in parts) | {"": opening}
        self._sections: list[tuple[str, list[str]]] = []
        self._files: list[str] = []

    def section(self, title: str, *parts: str | pd.DataFrame, **values: Any) -> None:
        """Add a section: its text with these values, then parts that are not empty: Markdown or
        tables.
        """
        texts = [self._notes[title].strip().format(**values)]
        for part in parts:
            if isinstance(part, pd.DataFrame):
                # An empty table would be a heading without rows.
                part = markdown(part) if len(part) else ""
            texts.append(part)
        self._sections.append((title, list(filter(None, texts))))

    def csv(self, name: str, rows: Rows) -> None:
        """Write rows with the same keys to `name.csv`, which the page links; StudyError if it
        cannot be.
        """
        path = self.out / f"{name}.csv"
        try:
            # Of objects, so that whole numbers stay such in a column with others.
            frame = pd.DataFrame(rows, dtype=object)
            with path.open("w", newline="", encoding="utf-8") as file:
                frame.to_csv(file, index=False, lineterminator="\r\n")
        except OSError as error:
            raise StudyError(f"{path}: {error.strerror}") from error
        self._files.append(f"[{path.name}]({path.name})")

    def write(self, conclusion: Sequence[str]) -> None:
        """Write the page `NAME.md`, the conclusion below its title; StudyError if it cannot be."""
        lines = [f"# {self._title}", "", *(f"- {line}" for line in conclusion), ""]
        lines += [QUICK, ""] if self._quick else []
        for title, parts in self._sections:
            lines += [f"## {title}", ""] if title else []
            lines += [line for part in parts for line in (part, "")]
        files = ", ".join(self._files)
        lines += [
            f"All figures: {files}. Computed by `sparseskin {self._command}`.",
            "",
        ]
        path = self.out / f"{self._name}.md"
        try:
            path.write_text("\n".join(lines), encoding="utf-8")
        except OSError as error:
            raise StudyError(f"{path}: {error.strerror}") from error
