"""Output of a study: CSV tables, charts and a Markdown page filled from a template."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeAlias

import jinja2
import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from .points import StudyError

Rows: TypeAlias = "pd.DataFrame | Sequence[Mapping[str, Any]]"

#: Okabe and Ito's colours, distinguishable for colour-blind readers; black last, for references.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")
#: Markers and line styles differ where colours do: charts are readable in grey print.
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
LINES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)))
PNG_DPI = 150
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
    "svg.hashsalt": "sparseskin",  # without it, the same chart is another file each time
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
    """A figure of panels in the common style, saved as it is left: `with Chart(...) as chart:`.

    Parameters
    ----------
    out : Path
        Folder of the study.
    name : str
        Name of the files: `name.png` and `name.svg`.
    caption : str
    n_panels, n_columns : int
        Panels, row by row.
    size_in : (float, float)
        Width and height of the figure in inches.
    legend_columns : int
        Columns of the legend below the panels; 0: no legend.
    **subplots
        As `Figure.subplots` takes them: sharex, sharey, ...

    Attributes
    ----------
    name, caption : str
    figure : matplotlib.figure.Figure
    panels : list of matplotlib.axes.Axes
    markdown : str
        Text that shows the chart on a page.

    Raises
    ------
    StudyError
        As it is left, if the files cannot be written.
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
        self._path, self.name, self.caption = out / name, name, caption
        self._n_columns, self._legend_columns = n_columns, legend_columns
        self.markdown = f"![{caption}]({name}.png)\n\n*{caption}* ([SVG]({name}.svg))"
        self._style = matplotlib.rc_context(_STYLE)
        with matplotlib.rc_context(_STYLE):
            self.figure = Figure(figsize=size_in, layout="constrained")
            FigureCanvasAgg(self.figure)
            n_rows = -(-n_panels // n_columns)
            grid = list(self.figure.subplots(n_rows, n_columns, squeeze=False, **subplots).flat)
        self.panels: list[Axes] = grid[:n_panels]
        for unused in grid[n_panels:]:
            unused.set_axis_off()

    def __enter__(self) -> Self:
        self._style.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
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
                for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
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
    """Draw one line for each value of a column.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    frame : DataFrame
    x, y, by : str
        Columns: places, heights, and what the lines are labelled by.
    order : sequence
        All values of `by`, whose styles are those of their places in it; by default those of
        this frame as they come.
    **style
        Changes of `series_style`.
    """
    labels = list(order) or list(frame[by].unique())
    for label, along in frame.groupby(by, sort=False):
        line = series_style(labels.index(label)) | style
        axes.plot(along[x], along[y], label=str(label), **line)


def markdown(frame: pd.DataFrame, formats: Mapping[str, str] | str = "") -> str:
    """Format a data frame as a Markdown table.

    Parameters
    ----------
    frame : DataFrame
        Its columns are the table's; missing values are empty cells.
    formats : mapping of str to str, or str
        Format of the numbers of a column, as `format` takes it: {"mean dB": ".1f"}; or of all.
    """

    def cell(value: Any, spec: str) -> str:
        if value is None or value is pd.NA or value != value:
            return ""
        return str(value) if isinstance(value, str) or not spec else format(value, spec)

    spec_of = [formats if isinstance(formats, str) else formats.get(column, "") for column in frame]
    # Of objects, so that whole numbers stay such in a row with others.
    lines = [list(map(str, frame)), ["---"] * len(spec_of)]
    for row in frame.astype(object).itertuples(index=False):
        lines.append([cell(value, spec) for value, spec in zip(row, spec_of, strict=True)])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def frame_of(
    points: Sequence[Mapping[str, Any]], found: Sequence[Mapping[str, Any]], by: str = ""
) -> pd.DataFrame:
    """Points with their figures as a data frame.

    A row a point; with `by`, a row for each name in the figures, which becomes that column.
    """
    rows: list[dict[str, Any]] = []
    for point, figures in zip(points, found, strict=True):
        of_point = {key: value for key, value in figures.items() if not isinstance(value, dict)}
        named = figures.get("methods", figures) if by else {"": {}}
        rows += [
            {**point, **of_point, **({by: name} if by else {}), **of} for name, of in named.items()
        ]
    return pd.DataFrame(rows)


def cells(frame: pd.DataFrame, text: str) -> list[str]:
    """Format each row of a frame, as in `cells(frame, "{mean_db:.1f} ({min_db:.1f})")`."""
    return [text.format(**row) for row in frame.to_dict("records")]


def pivot(frame: pd.DataFrame, index: Sequence[str], columns: str, values: str) -> pd.DataFrame:
    """Spread the values of one column over a column each of another's, in their given order."""
    table = frame.pivot_table(values, list(index), columns, aggfunc="first", sort=False)
    return table.reset_index()


def write_csv(out: Path, name: str, rows: Rows) -> str:
    """Write a data frame, or rows with the same keys, to `name.csv`; the Markdown that links it.

    Raises
    ------
    StudyError
        If it cannot be written.
    """
    path = out / f"{name}.csv"
    try:
        # Of objects, so that whole numbers stay such in a column with others.
        frame = pd.DataFrame(rows, dtype=object)
        with path.open("w", newline="", encoding="utf-8") as file:
            frame.to_csv(file, index=False, lineterminator="\r\n")
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror}") from error
    return f"[{path.name}]({path.name})"


def fill_page(
    out: Path,
    name: str,
    template: Path | None = None,
    conclusion: Sequence[str] = (),
    **values: Any,
) -> Path:
    """Fill a template and write it as the study's page `name.md`.

    Parameters
    ----------
    out : Path
        Folder of the study.
    name : str
        Name of the page.
    template : Path, optional
        Markdown with Jinja2 expressions; `x|f(".1f")` formats a number as Python does. By
        default `page.md` in the folder of the study of that name.
    conclusion : sequence of str
        What the figures show, three lines at most; they stand below the title.
    **values
        What the expressions name; a data frame is shown as a table.

    Raises
    ------
    StudyError
        If the page cannot be written.
    jinja2.UndefinedError
        If the template names something that is not among the values.
    """
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
        finalize=lambda value: markdown(value) if isinstance(value, pd.DataFrame) else value,
    )
    environment.filters["f"] = format
    path = out / f"{name}.md"
    template = template or Path(__file__).parent / name.replace("-", "_") / "page.md"
    text = environment.from_string(template.read_text(encoding="utf-8")).render(values)
    if conclusion:
        title, _, rest = text.lstrip().partition("\n")
        text = "\n".join([title, "", *(f"- {line}" for line in conclusion[:3]), rest])
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror}") from error
    return path
