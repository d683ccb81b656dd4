"""The page of study `targets`: wanted figures, reached ones, and the part of each ingredient."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from sparseskin.nodes.reconstructor.settings import PRESETS
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

from .scenes import RANDOM

RATIOS = (3, 4, 8)
METHODS = ("skin", "skin, rotating")
#: Wanted gain over preset paper, dB, by number of taxels and ratio.
WANTED_DB = {1600: {3: 12, 4: 14, 8: 17}, 4096: {3: 11, 4: 12, 8: 17}}
WANTED_WORST_DB, WANTED_FOUND = 13, 0.95
#: Force of a light touch on each of nine taxels, and the mean of nine taxels that detects it.
LIGHT_TOUCH_N, THRESHOLD_N = 0.05, 0.01
#: Half width of a band that is to hold 90 % of the truth, in standard deviations.
DEVIATIONS = 1.645
#: Ingredients on the page, where points are stored under other names.
RENAMED = {
    "weight of the prediction (K = 1)": "gain of the prediction (gain 1)",
    "more iterations where surprised": "more iterations where the innovation is large",
    "rows of earlier phases": "rows of earlier subsets",
}
HELD = ("touched", "untouched", "total", "row", "col")


def write(
    out: Path,
    reconstructed: pd.DataFrame,
    touched: pd.DataFrame,
    banded: pd.DataFrame,
    recorded: pd.DataFrame,
    ablated: pd.DataFrame,
) -> None:
    """Write tables, charts and the page into a folder.

    Parameters
    ----------
    out : Path
    reconstructed, touched, banded, recorded, ablated : DataFrame
        Points with the figures of the functions of these names in `study`; a row a method in
        `reconstructed` and a row an ingredient in `ablated`.
    """
    columns = ["scene", "n", "ratio", "method", "mean_db", "min_db", "touched_n", "p50_ms"]
    compared = _compared(reconstructed)
    ablated = ablated.assign(without=ablated["without"].replace(RENAMED))
    names = list(ablated["without"].unique())
    changes = _changes(ablated, names[0])
    reached = _reached(compared)
    fill_page(
        out,
        "targets",
        conclusion=conclusion(reached),
        **{
            "reached": reached,
            "wanted_db": WANTED_DB,
            "wanted_worst_db": WANTED_WORST_DB,
        },
        gains=[_draw_gain(out, compared, method) for method in METHODS],
        scenes=_scene_table(reconstructed),
        scenes_csv=write_csv(out, "scenes", reconstructed[[*columns, "p99_ms"]]),
        touched=_touched_table(reconstructed),
        pylops_iterations=PRESETS["paper"]["iterations"],
        light=touched,
        light_n=LIGHT_TOUCH_N,
        threshold_n=THRESHOLD_N,
        wanted_found=100 * WANTED_FOUND,
        deviations=DEVIATIONS,
        bands=_bands_table(banded),
        recorded=recorded,
        ablation_chart=_draw_ablation(out, changes, names[1:]),
        ablation={kind: changes.loc[kind] for kind in changes.index.unique("kind")},
        ingredients=names[1:],
    )


def conclusion(reached: pd.DataFrame) -> list[str]:
    """A line a method: gains over preset paper beside the wanted ones, in the paper's scenes."""
    lines = []
    for method in METHODS:
        some = reached[(reached["method"] == method) & (reached["kind"] != "random")]
        parts, n = [], 0
        for row in some[some["n"].isin(WANTED_DB)].itertuples():
            wanted = WANTED_DB[row.n][row.ratio]
            parts.append(f"{row.gain:+.1f} dB at N/{row.ratio} of {row.n} (wanted {wanted})")
            n += row.gain >= wanted
        if parts:
            text = f"{method} reaches {n} of {len(parts)} wanted gains over preset paper"
            lines.append(f"{text}: {', '.join(parts)}.")
    return lines


def _best_zone(reconstructed: pd.DataFrame) -> pd.DataFrame:
    """By scene the best dead zone of the full reading: method, mean_db."""
    zones = reconstructed[reconstructed["method"].str.startswith("dead zone")]
    return zones.loc[zones.groupby("scene")["mean_db"].idxmax()].set_index("scene")


def _reading(reconstructed: pd.DataFrame, method: str) -> pd.DataFrame:
    """By scene the figures of a method at ratio 1."""
    found = reconstructed[(reconstructed["ratio"] == 1) & (reconstructed["method"] == method)]
    return found.set_index("scene")


def _compared(reconstructed: pd.DataFrame) -> pd.DataFrame:
    """Rows of `METHODS` with their gains over paper and over the reading, dB."""
    keys = ["scene", "ratio"]
    of = reconstructed[reconstructed["ratio"].isin(RATIOS)]
    paper = of[of["method"] == "paper"][[*keys, "mean_db", "min_db"]]
    rows = of[of["method"].isin(METHODS)].merge(paper, on=keys, suffixes=("", "_paper"))
    raw_db = rows["scene"].map(_reading(reconstructed, "raw")["mean_db"])
    zone_db = rows["scene"].map(_best_zone(reconstructed)["mean_db"])
    return rows.assign(
        gain=rows["mean_db"] - rows["mean_db_paper"],
        worst=rows["min_db"] - rows["min_db_paper"],
        over_raw=rows["mean_db"] - raw_db,
        over_zone=rows["mean_db"] - zone_db,
        kind=["random" if scene.startswith(RANDOM) else "the paper's" for scene in rows["scene"]],
    )


def _reached(compared: pd.DataFrame) -> pd.DataFrame:
    """Gains of each method by size, kind of scene and ratio."""
    groups = compared.groupby(["n", "kind", "ratio", "method"], sort=False)
    rows = groups.agg(
        gain=("gain", "mean"),
        least=("gain", "min"),
        worst=("worst", "mean"),
        over=("over_raw", "mean"),
        over_least=("over_raw", "min"),
        zone=("over_zone", "mean"),
    ).reset_index()
    return rows.sort_values("n", kind="stable")


def _scene_table(reconstructed: pd.DataFrame) -> str:
    rows = reconstructed[reconstructed["ratio"] > 1]
    rows = rows.assign(M=cells(rows, "N/{ratio}"), cell=cells(rows, "{mean_db:.1f} / {min_db:.1f}"))
    table = pivot(rows, ["scene", "M"], "method", "cell").rename(columns={"fista, tuned": "tuned"})
    zone = _best_zone(reconstructed)
    zone["cell"] = [
        f"{mean_db:.1f} ({method.split()[2]} N)"
        for method, mean_db in zip(zone["method"], zone["mean_db"], strict=True)
    ]
    table["raw"] = _of_reading(table, reconstructed, "raw")
    table["raw, best dead zone"] = table["scene"].map(zone["cell"])
    table["denoised"] = _of_reading(table, reconstructed, "skin")
    return markdown(table)


def _of_reading(table: pd.DataFrame, reconstructed: pd.DataFrame, method: str) -> pd.Series:
    reading = _reading(reconstructed, method)
    reading["cell"] = cells(reading, "{mean_db:.1f} / {min_db:.1f}")
    return table["scene"].map(reading["cell"])


def _touched_table(reconstructed: pd.DataFrame) -> str:
    rows = reconstructed[
        reconstructed["ratio"].isin(RATIOS) & reconstructed["method"].isin(["paper", *METHODS])
    ]
    rows = rows.assign(
        M=cells(rows, "N/{ratio}"),
        touched_mn=1e3 * rows["touched_n"],
        times=cells(rows, "{p50_ms:.2f} / {p99_ms:.2f}"),
        faster=rows["pylops_ms"].astype(float) / rows["p50_ms"],
    )
    keys = ["scene", "M"]
    touched = pivot(rows, keys, "method", "touched_mn")
    raw_mn = 1e3 * _reading(reconstructed, "raw")["touched_n"]
    table = touched[keys].assign(**{"raw, mN": touched["scene"].map(raw_mn)})
    for values, unit in (("touched_mn", "mN"), ("times", "ms")):
        of = pivot(rows, keys, "method", values)
        for name in ("paper", *METHODS):
            table[f"{name}, {unit}"] = of[name]
    if rows["pylops_ms"].notna().any():
        table["PyLops, ms"] = pivot(rows, keys, "method", "pylops_ms")["paper"].astype(float)
        faster = pivot(rows, keys, "method", "faster")
        table["times paper"], table[f"times {METHODS[-1]}"] = faster["paper"], faster[METHODS[-1]]
    return markdown(table, ".1f")


def _bands_table(banded: pd.DataFrame) -> str:
    def shown(row: pd.Series) -> str:
        return " / ".join("-" if part != part else f"{100 * part:.0f}" for part in row[list(HELD)])

    of_all = banded.groupby(["rows", "ratio"], sort=False)[list(HELD)].mean().reset_index()
    # As rows of fixed and of rotating rows for each scene, and the means below.
    kinds = {scene: k for k, scene in enumerate(banded["scene"].unique())}
    rows = banded.sort_values("scene", key=lambda names: names.map(kinds), kind="stable")
    rows = pd.concat([rows, of_all.assign(scene="**mean**")])
    rows = rows.assign(M=cells(rows, "N/{ratio}"), cell=rows.apply(shown, axis=1))
    return markdown(pivot(rows, ["scene", "rows"], "M", "cell"))


def _changes(ablated: pd.DataFrame, whole: str) -> pd.DataFrame:
    """Mean change without each ingredient, by kind (ratio and rows): dB, dB, microseconds."""
    keys = ["scene", "ratio", "rows"]
    figures = ["mean_db", "min_db", "p50_ms"]
    of_whole = ablated[ablated["without"] == whole][[*keys, *figures]]
    rows = ablated.merge(of_whole, on=keys, suffixes=("", "_whole"))
    for name in figures:
        rows[name] -= rows[f"{name}_whole"]
    rows["kind"] = cells(rows, "N/{ratio}, {rows}")
    return rows.groupby(["kind", "without"], sort=False)[figures].mean()


def _draw_gain(out: Path, compared: pd.DataFrame, method: str) -> str:
    of = compared[compared["method"] == method]
    scenes = list(of["scene"].unique())[::-1]
    name, caption = "gain_" + method.replace(", ", "_"), f"Gain of {method} over preset paper"
    with Chart(
        out,
        name,
        f"{caption}, by scene; frames 1 ms apart, 0.1 ms in *_64",
        size_in=(8.0, 0.3 * len(scenes) + 2.0),
    ) as chart:
        (axes,) = chart.panels
        for k, ratio in enumerate(RATIOS):
            gains = of[of["ratio"] == ratio].set_index("scene")["gain"][scenes]
            axes.plot(gains, scenes, MARKERS[k], color=PALETTE[k], label=f"M = N/{ratio}")
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_xlabel("mean PSNR over preset paper, same frames, dB")
    return chart.markdown


def _draw_ablation(out: Path, changes: pd.DataFrame, names: list[str]) -> str:
    kinds = list(changes.index.unique("kind"))
    height, size_in = 0.8 / len(kinds), (8.0, 0.35 * len(names) + 1.8)
    with Chart(out, "ablation", "One ingredient left out at a time", size_in=size_in) as chart:
        (axes,) = chart.panels
        for (k, kind), hatch in zip(enumerate(kinds), ("", "///", "..."), strict=False):
            places = [-row - k * height for row in range(len(names))]
            change = changes.loc[kind].loc[names]["mean_db"]
            axes.barh(places, change, height, color=PALETTE[k], label=kind, hatch=hatch)
        axes.set_yticks([-row - height / 2 for row in range(len(names))], names)
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_xlabel("change of mean PSNR without it, dB")
    return chart.markdown
