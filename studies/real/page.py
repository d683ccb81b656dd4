"""The table and the page of study `real`: errors by recording, ratio and method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.ticker import LogLocator

from sparseskin.launch.attach.text import GAP, width, wrapped
from sparseskin.nodes.compressor.phi.rotation import PAPER
from sparseskin.studies.report import (
    MARKERS,
    PALETTE,
    Chart,
    cells,
    fill_page,
    markdown,
    pivot,
    write_csv,
)

from .methods import (
    ADAPTIVE,
    ALONE,
    CODECS,
    REPLAY,
    ROTATED,
    SIMPLE,
    SKIN,
    VALUE_BYTES,
    replayed,
)
from .recordings import GHOST, LOADED, UNTOUCHED, Recording

RATIOS = (3, 4, 8)
#: Order of the columns.
METHODS = (SKIN, ROTATED, ADAPTIVE, REPLAY, ALONE, PAPER, *SIMPLE)
LEAST_ERROR = 0.5
"""Least relative error that a quotient is formed with, in %. Chosen: about that of readings in 8
bits, so that below it all methods are as good as exact."""
WRONG, RIGHT = 0.5, 0.1
"""Relative errors above which a frame should be marked as not to be trusted, and below which it
should not be. Chosen."""
_KEYS = ["recording", "M"]


def show(frame: pd.DataFrame) -> list[str]:
    """Return the lines that the terminal shows: errors, then what vanished, ghosts and flags.

    Parameters
    ----------
    frame : DataFrame
        A row a point and method: recording, ratio, seed, method, and the figures of `figures_of`.
    """
    rows = _means(frame)
    compared = rows[rows["ratio"] > 1]
    codecs = rows[rows["ratio"] == 1]
    lines = ["relative error of loaded frames in %: median (mean)"]
    lines += _aligned(_table(compared, "{median:.1f} ({mean:.1f})"))
    for name, what in (
        ("vanished", "loaded frames with a relative error of 90 % or more, in %"),
        ("ghosts", "untouched frames with a reconstructed force, in %"),
        ("flagged", "frames that the solver marks as not to be trusted, in %"),
    ):
        some = compared[compared[name].fillna(0) > 0]
        if len(some):
            table = _table(compared[compared["key"].isin(some["key"])], f"{{{name}:.0f}}")
            lines += ["", what, *_aligned(table)]
    if marked(rows):
        lines += ["", *_flowing(marked(rows))]
    if len(codecs):
        lines += ["", "all taxels read: bytes a frame / median relative error in %"]
        lines += _aligned(_codecs(rows))
    return [*lines, "", *_flowing([*geometric(rows), *beaten(rows), *packed(rows)])]


def _flowing(sentences: Sequence[str]) -> list[str]:
    """Sentences as lines of the terminal."""
    return [line for sentence in sentences for line in wrapped("", sentence, "  ")]


def write(
    out: Path,
    frame: pd.DataFrame,
    parts: Mapping[str, Recording],
    *,
    unscored: int,
    vanished: float,
) -> None:
    """Write tables, chart and the page into a folder.

    Parameters
    ----------
    out : Path
    frame : DataFrame
        As in `show`.
    parts : mapping of str to Recording
        By recording.
    unscored : int
        Number of frames at the begin of a part that are not scored.
    vanished : float
        Relative error from which a contact counts as vanished.
    """
    rows = _means(frame)
    compared = rows[rows["ratio"] > 1]
    has_flags = bool(compared["flagged"].notna().any())
    failed = frame[frame["failed"].notna()] if "failed" in frame else frame[:0]
    fill_page(
        out,
        "real",
        conclusion=[*dict.fromkeys(beaten(rows)[:: len(RATIOS) - 1]), *packed(rows)],
        loaded=100 * LOADED,
        untouched=100 * UNTOUCHED,
        ghost=100 * GHOST,
        vanished=100 * vanished,
        unscored=unscored,
        value_bytes=VALUE_BYTES,
        least=LEAST_ERROR,
        n_seeds=int(frame["seed"].nunique()),
        replayed=replayed(),
        recordings=_recordings(frame, parts),
        chart=_draw(out, compared),
        beaten=[*beaten(rows), *packed(rows)],
        geometric=geometric(rows),
        errors=_shown(compared, "{median:.1f} / {mean:.1f}"),
        lost=_shown(compared, "{vanished:.0f} / {ghosts:.0f}"),
        flags=_shown(compared, "{flagged:.0f} / {flagged_wrong:.0f} / {flagged_right:.0f}")
        if has_flags
        else "",
        estimates=_shown(
            compared, "{estimate_median:.2f} ({estimate_low:.2f} to {estimate_high:.2f})"
        ),
        marked=marked(rows),
        wrong=100 * WRONG,
        right=100 * RIGHT,
        codecs=markdown(_codecs(rows)),
        failed=[f"{row.recording}, {row.method}: {row.failed}" for row in failed.itertuples()],
        csv=write_csv(out, "methods", frame.drop(columns=["path"])),
    )


def geometric(rows: pd.DataFrame) -> list[str]:
    """Return a line a kind of rows of the default solver: geometric mean over the recordings."""
    lines = []
    for name, some in rows[rows["method"].isin([SKIN, ROTATED])].groupby("method", sort=False):
        logs = np.log(some["median"]).groupby(some["M"], sort=False).mean()
        means = ", ".join(f"{mean:.2f} % at {M}" for M, mean in np.exp(logs).items())
        lines.append(f"{name}: geometric mean of the median errors {means}")
    return lines


def beaten(rows: pd.DataFrame) -> list[str]:
    """Return a line a ratio: where the best simple method beats the default of `replay`."""
    lines = []
    for ratio, some in _quotients(rows).groupby("ratio", sort=True):
        worse = list(some[some["quotient"] > 1]["recording"])
        median = float(some["quotient"].median())
        named = f": {', '.join(worse)}" if worse else ""
        lines.append(
            f"N/{ratio}: the best simple method beats {replayed()} on {len(worse)} of {len(some)} "
            f"recordings{named}; quotient of the errors: {median:.2f} in the median"
        )
    return lines


def marked(rows: pd.DataFrame) -> list[str]:
    """Return a line a method whose solver estimates its error: marks and estimate, by the truth.

    The parts marked are of the frames of all recordings and ratios, the quotients in the median
    over these.
    """
    lines = []
    for name, some in rows[rows["estimate_median"].notna()].groupby("method", sort=False):
        parts = [
            f"{(some[f'flagged_{which}'] * some[f'n_{which}']).sum() / n:.1f} % of {n:.0f} frames "
            f"with an error {bound}"
            for which, bound in (
                ("wrong", f"above {100 * WRONG:g} %"),
                ("right", f"below {100 * RIGHT:g} %"),
            )
            if (n := some[f"n_{which}"].sum())
        ]
        low, middle, high = (some[f"estimate_{k}"].median() for k in ("low", "median", "high"))
        lines.append(
            f"{name} marks {' and '.join(parts) or 'no frame'}; estimated over true RMS error "
            f"{middle:.2f} (5 to 95 %: {low:.2f} to {high:.2f})"
        )
    return lines


def packed(rows: pd.DataFrame) -> list[str]:
    """Return the line on all taxels in 8 bits, packed, beside the default of `replay`."""
    codec = rows[rows["method"] == CODECS[0]].set_index("recording")
    ours = rows[(rows["method"] == replayed()) & (rows["ratio"] > 1)]
    if codec.empty or ours.empty:
        return []
    smaller = ours["recording"].map(codec["n_bytes"]) < ours["n_bytes"]
    counts = [
        f"at {M} on {int(smaller[some.index].sum())} of {len(some)}"
        for M, some in ours.groupby("M", sort=False)
    ]
    return [
        f"all taxels in 8 bits, packed by zstd, are fewer bytes than {replayed()}: "
        f"{', '.join(counts)} recordings; error {codec['median'].median():.2g} % in the median"
    ]


def _means(frame: pd.DataFrame) -> pd.DataFrame:
    """Figures of each method in the mean over the seeds, in the order of `METHODS`."""
    known = frame[frame["median"].notna()] if "median" in frame else frame
    keys = ["recording", "ratio", "method"]
    figures = ["median", "mean", "vanished", "ghosts", "flagged", "n_values", "n_bytes", "cpu_ms"]
    figures += ["flagged_wrong", "flagged_right", "n_wrong", "n_right"]
    figures += ["estimate_low", "estimate_median", "estimate_high"]
    known = known.reindex(columns=[*keys, *figures])
    rows = known.astype(dict.fromkeys(figures, float)).groupby(keys, sort=False)[figures].mean()
    rows = rows.reset_index()
    order = [*METHODS, *CODECS]
    rows = rows.sort_values("method", key=lambda names: names.map(order.index), kind="stable")
    names = list(frame["recording"].unique())
    rows = rows.sort_values(["ratio"], kind="stable").sort_values(
        "recording", key=lambda of: of.map(names.index), kind="stable"
    )
    rows["M"] = cells(rows, "N/{ratio}")
    rows["key"] = rows["recording"] + " " + rows["M"]
    return rows


def _table(rows: pd.DataFrame, text: str) -> pd.DataFrame:
    rows = rows.assign(cell=[cell.replace("nan", "-") for cell in cells(rows, text)])
    # In the order of the rows: a pivot keeps that of recordings, or of M, but not of both.
    keys = rows[_KEYS].drop_duplicates()
    table = keys.merge(pivot(rows, _KEYS, "method", "cell"), on=_KEYS)
    return table[[*_KEYS, *(name for name in METHODS if name in table)]].fillna("-")


def _aligned(table: pd.DataFrame) -> list[str]:
    """Lines of a table in columns, which are continued below where the terminal is too narrow; what
    repeats in the first column is left out.
    """
    table = table.astype(str)
    n_keys = 1
    if "M" in table:
        n_keys = 2
        table["recording"] = table["recording"].where(~table["recording"].duplicated(), "")
    columns = [
        [cell.ljust(size) if k < 1 else cell.rjust(size) for cell in (name, *table[name])]
        for k, name in enumerate(table)
        if (size := max(len(name), *table[name].map(len)))
    ]
    keys, rest = columns[:n_keys], columns[n_keys:]
    lines: list[str] = []
    while rest:
        room = width() - sum(len(column[0]) + len(GAP) for column in keys)
        n = next((k for k in range(len(rest), 1, -1) if _span(rest[:k]) <= room), 1)
        part, rest = rest[:n], rest[n:]
        lines += [GAP.join(cells).rstrip() for cells in zip(*keys, *part, strict=True)]
        lines += [""] if rest else []
    return lines


def _span(columns: Sequence[Sequence[str]]) -> int:
    """Characters of a line of columns."""
    return sum(len(column[0]) for column in columns) + len(GAP) * (len(columns) - 1)


def _shown(rows: pd.DataFrame, text: str) -> str:
    return markdown(_table(rows, text))


def _codecs(rows: pd.DataFrame) -> pd.DataFrame:
    """Bytes and errors of the codecs, beside those of the default at each ratio."""
    sent = rows[rows["method"].isin([*CODECS, replayed()])]
    default = sent["ratio"] > 1
    sent = sent.assign(
        method=np.where(default, sent["method"] + ", " + sent["M"], sent["method"]),
        cell=cells(sent, "{n_bytes:.0f} / {median:.3g}"),
    )
    return pivot(sent, ["recording"], "method", "cell").fillna("-")


def _quotients(rows: pd.DataFrame) -> pd.DataFrame:
    """Error of the default of `replay` over that of the best simple method, by medians."""
    keys = ["recording", "ratio"]
    ours = rows[(rows["method"] == replayed()) & (rows["ratio"] > 1)].set_index(keys)["median"]
    simple = rows[rows["method"].isin(SIMPLE)]
    best = simple.loc[simple.groupby(keys, sort=False)["median"].idxmin()].set_index(keys)
    found = pd.DataFrame({"ours": ours, "best": best["median"], "by": best["method"]}).dropna()
    found["quotient"] = found["ours"].clip(LEAST_ERROR) / found["best"].clip(LEAST_ERROR)
    return found.reset_index()


def _recordings(frame: pd.DataFrame, parts: Mapping[str, Recording]) -> pd.DataFrame:
    counts = frame.groupby("recording", sort=False)[["n_loaded", "n_untouched"]].max()
    lines = []
    for name, part in parts.items():
        n_rows, n_cols = part.skin.mask.shape
        stop = part.first + len(part.frames)
        x = part.truth[:, part.skin.mask].astype(np.float64)
        changes, norms = np.linalg.norm(np.diff(x, axis=0), axis=1), np.linalg.norm(x[1:], axis=1)
        loaded = norms > LOADED * part.norm
        change = np.median(changes[loaded] / norms[loaded]) if loaded.any() else 0.0
        lines.append(
            {
                "recording": name,
                "grid": f"{n_rows} x {n_cols}",
                "N": part.skin.n,
                "unit": part.unit,
                "frames": f"{part.first}..{stop - 1} of {part.n_recorded}",
                "loaded": int(counts["n_loaded"].get(name, 0)),
                "untouched": int(counts["n_untouched"].get(name, 0)),
                "spacing": "-" if part.spacing_ms is None else f"{part.spacing_ms:.3g} ms",
                "pressed, %": f"{100 * np.mean(x > 0):.0f}",
                "change, %": f"{100 * change:.1f}",
            }
        )
    return pd.DataFrame(lines)


def _draw(out: Path, rows: pd.DataFrame) -> str:
    quotients = _quotients(rows)
    names = list(dict.fromkeys(rows["recording"]))[::-1]
    caption = f"Error of {replayed()} over that of the best simple method"
    size_in = (7.5, 0.42 * len(names) + 1.9)
    with Chart(out, "quotients", caption, size_in=size_in) as chart:
        (axes,) = chart.panels
        axes.set_xscale("log")
        for k, ratio in enumerate(RATIOS):
            some = quotients[quotients["ratio"] == ratio]
            heights = [names.index(name) + 0.2 * (1 - k) for name in some["recording"]]
            axes.plot(
                some["quotient"],
                heights,
                MARKERS[k],
                color=PALETTE[k],
                markersize=7,
                label=f"M = N/{ratio}",
            )
        axes.axvline(1, color="black", linewidth=1.2)
        low = min(0.5, *quotients["quotient"] / 1.3) if len(quotients) else 0.5
        high = max(2.0, *quotients["quotient"] * 1.3) if len(quotients) else 2.0
        axes.axvspan(1, high, color=PALETTE[1], alpha=0.08, zorder=0)
        axes.set_xlim(low, high)
        above = axes.get_xaxis_transform()
        axes.text(
            0.97, 1.01, f"\u2190 {replayed()} is better", fontsize=9, ha="right", transform=above
        )
        axes.text(1.03, 1.01, "simple is better \u2192", fontsize=9, ha="left", transform=above)
        axes.set_ylim(-0.6, len(names) - 0.4)
        axes.set_yticks(range(len(names)), names)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
        axes.set_xlabel("quotient of the median relative errors")
    return chart.markdown
