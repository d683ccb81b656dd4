"""The page of study `bases`: the question of D2 or D4, for every basis, and of how to sample."""

from __future__ import annotations

from collections.abc import Mapping
from math import log10
from pathlib import Path
from typing import Any

import pandas as pd

from sparseskin.studies.report import (
    MARKERS,
    PALETTE,
    Chart,
    cells,
    draw_lines,
    fill_page,
    markdown,
    pivot,
    write_csv,
)

#: Parts of the N coefficients whose energy is computed.
KEPT_PARTS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
#: The paper's, and ones from half of it to eight times it, newtons.
LAMBDAS_N = tuple(0.003125 * 2.0**k for k in range(-1, 4))
#: Kind of Phi, and preset or solver, by their names on the page.
SAMPLINGS = {
    "paper": ("sbhe", "paper"),
    "skin": ("sbhe", "skin"),
    "subsample": ("subsample", "interpolation"),
    "acts": ("acts", "interpolation"),
}
PAPERS_LAMBDA = LAMBDAS_N.index(0.003125)
#: Part of the coefficients in the table: 2 % of them.
SHOWN_PART = KEPT_PARTS.index(0.02)
#: Least part of an energy that float32 resolves.
LEAST_MISSING = 1e-12
NAMES = {"haar": "haar (D2)", "db2": "db2 (D4)"}
COMPARED = (
    ("D4 in place of D2 changes that by", "db2", "haar"),
    ("Learning from other bodies adds to Haar on the same tiles", "learned", "haar, tiles"),
    ("Learning from the same body adds to it", "learned, same body", "haar, tiles"),
)


def write(
    out: Path,
    counted: pd.DataFrame,
    reconstructed: pd.DataFrame,
    sampled: pd.DataFrame,
    spacing: Mapping[str, tuple[float, float]],
) -> None:
    """Write tables, charts and the page into a folder.

    Frames have columns scene, basis or sampling, (ratio), and the figures of the functions
    `coefficients`, `reconstructed` and `sampled`. `spacing` is by scene the time between frames in
    ms, of those of bases and of those of samplings.
    """
    counted = counted.assign(missing_2_percent=counted["missing"].str[SHOWN_PART])
    found = reconstructed.merge(counted, on=["scene", "basis"])
    best = found["mean_db"].map(lambda by_lambda: by_lambda.index(max(by_lambda)))
    found = found.assign(
        n_nonzero=found["n_nonzero"].round(1),
        mean_db=found["mean_db"].map(max),
        min_db=[of[k] for of, k in zip(found["min_db"], best, strict=True)],
        lambda_n=best.map(LAMBDAS_N.__getitem__),
        mean_db_papers_lambda=found["mean_db"].str[PAPERS_LAMBDA],
    )
    columns = ["scene", "basis", "ratio", "n_nonzero", "missing_2_percent", "mean_db", "min_db"]
    table = found[[*columns, "lambda_n", "mean_db_papers_lambda", "n_frames"]]
    n_nonzero = counted.pivot(index="scene", columns="basis", values="n_nonzero")
    tuned = found.pivot(index=["scene", "ratio"], columns="basis", values="mean_db")
    # In the order of the bases where two are equal.
    ranked = tuned.groupby("ratio").mean()[list(counted["basis"].unique())]
    means = sampled.groupby(["ratio", "sampling"], sort=False)["mean_db"].mean().unstack(sort=False)
    by_sampling = sampled.pivot(index=["ratio", "scene"], columns="sampling", values="mean_db")
    fill_page(
        out,
        "bases",
        conclusion=conclusion(n_nonzero, ranked, by_sampling),
        fewer=n_nonzero["haar"] < n_nonzero["db2"],
        times=(n_nonzero["db2"] / n_nonzero["haar"]).mean(),
        ranked={
            ratio: means_db.sort_values(ascending=False, kind="stable")
            for ratio, means_db in ranked.rename(columns=NAMES).iterrows()
        },
        gains=[(text, tuned[basis] - tuned[other]) for text, basis, other in COMPARED],
        spacing=spacing,
        counted=_counted_table(counted),
        energy=_draw_missing(out, counted),
        reconstructed=_reconstructed_table(found),
        tuned=_draw_reconstructed(out, found),
        bases_csv=write_csv(out, "bases", table),
        means=means.sort_index(),
        ahead=(by_sampling["acts"] > by_sampling["paper"]).groupby("ratio").sum(),
        behind=(by_sampling["acts"] < by_sampling["skin"]).groupby("ratio").sum(),
        n_scenes=sampled["scene"].nunique(),
        sampled=_sampled_table(sampled),
        sampling=_draw_sampled(out, sampled, spacing),
        sampling_csv=write_csv(out, "sampling", sampled),
    )


def conclusion(
    n_nonzero: pd.DataFrame, ranked: pd.DataFrame, by_sampling: pd.DataFrame
) -> list[str]:
    """Coefficients of Haar and D4, the best basis by ratio, and taxels chosen anew by scene."""
    fewer = n_nonzero["haar"] < n_nonzero["db2"]
    best = ", ".join(
        f"{NAMES.get(name, name)} at N/{ratio} ({db:.1f} dB)"
        for ratio, name, db in zip(
            ranked.index, ranked.idxmax(axis=1), ranked.max(axis=1), strict=True
        )
    )
    ahead = (by_sampling["acts"] > by_sampling["skin"]).sum()
    return [
        f"Haar (D2) needs fewer coefficients than D4 in {fewer.sum()} of {len(fewer)} scenes, "
        f"{(n_nonzero['db2'] / n_nonzero['haar']).mean():.1f} times fewer in the mean.",
        f"Best in the mean of the scenes: {best}.",
        f"Taxels that are chosen anew in each frame beat the default in {ahead} of "
        f"{len(by_sampling)} cases.",
    ]


def _counted_table(counted: pd.DataFrame) -> str:
    decibels = [
        "< -120" if part < LEAST_MISSING else f"{10 * log10(part):.0f}"
        for part in counted["missing_2_percent"]
    ]
    shown = counted.assign(basis=counted["basis"].replace(NAMES), decibels=decibels)
    shown["cell"] = cells(shown, "{n_nonzero:.0f} ({decibels})")
    return markdown(pivot(shown, ["basis"], "scene", "cell"))


def _reconstructed_table(found: pd.DataFrame) -> str:
    order = {name: k for k, name in enumerate(found["basis"].unique())}
    shown = found.sort_values("basis", key=lambda names: names.map(order), kind="stable")
    shown = shown.assign(
        basis=shown["basis"].replace(NAMES),
        M=cells(shown, "N/{ratio}"),
        cell=cells(shown, "{mean_db:.1f} ({mean_db_papers_lambda:.1f})"),
    )
    return markdown(pivot(shown, ["basis", "M"], "scene", "cell"))


def _sampled_table(sampled: pd.DataFrame) -> str:
    shown = sampled.assign(
        M=cells(sampled, "N/{ratio}"), cell=cells(sampled, "{mean_db:.1f} ({min_db:.1f})")
    )
    table = pivot(shown, ["scene", "M"], "sampling", "cell")
    return markdown(table.rename(columns={"reading": "all taxels read"}))


def _draw_missing(out: Path, counted: pd.DataFrame) -> str:
    scenes = counted["scene"].unique()
    lines = counted.explode("missing").assign(
        missing=lambda frame: frame["missing"].clip(lower=LEAST_MISSING).astype(float),
        percent=[100 * part for part in KEPT_PARTS] * len(counted),
    )
    caption = "Energy of the true forces outside the K largest"
    n, size_in = len(scenes), (8.0, 2.4 * -(-len(scenes) // 2) + 1.0)
    with Chart(out, "energy", caption, n, 2, size_in=size_in, sharex=True, sharey=True) as chart:
        for axes, scene in zip(chart.panels, scenes, strict=True):
            draw_lines(axes, lines[lines["scene"] == scene], "percent", "missing", "basis")
            axes.set(title=scene, xscale="log", yscale="log")
        chart.label("largest coefficients kept, % of N", "")
        chart.figure.supylabel("part of the energy that is missing")
    return chart.markdown


def _draw_reconstructed(out: Path, found: pd.DataFrame) -> str:
    bases, ratios = found["basis"].unique()[::-1], sorted(found["ratio"].unique())
    caption = "FISTA with the best lambda, by basis and scene; frame spacing: see the page"
    size_in = (8.0, 0.3 * len(bases) + 1.8)
    n = len(ratios)
    style: dict[str, Any] = {"size_in": size_in, "legend_columns": 3, "sharey": True}
    with Chart(out, "reconstructed", caption, n, n, **style) as chart:
        for axes, ratio in zip(chart.panels, ratios, strict=True):
            of_ratio = found[found["ratio"] == ratio]
            for k, (scene, of) in enumerate(of_ratio.groupby("scene", sort=False)):
                best_db = of.set_index("basis")["mean_db"]
                axes.plot(best_db[bases], bases, MARKERS[k], color=PALETTE[k], label=scene)
            axes.set(title=f"M = N/{ratio}", xlabel="mean PSNR, dB")
    return chart.markdown


def _draw_sampled(
    out: Path, sampled: pd.DataFrame, spacing: Mapping[str, tuple[float, float]]
) -> str:
    scenes = sampled["scene"].unique()
    lines = sampled.assign(percent=100 / sampled["ratio"])
    caption = "PSNR in contact over M: what is measured, and how"
    size_in = (8.0, 2.4 * -(-len(scenes) // 2) + 1.0)
    style: dict[str, Any] = {"size_in": size_in, "legend_columns": 5, "sharex": True}
    with Chart(out, "sampling", caption, len(scenes), 2, **style) as chart:
        for axes, scene in zip(chart.panels, scenes, strict=True):
            of = lines[lines["scene"] == scene]
            reading_db = of[of["sampling"] == "reading"]["mean_db"].iloc[0]
            axes.axhline(reading_db, color="grey", linewidth=1.0, label="all taxels read")
            draw_lines(axes, of[of["sampling"] != "reading"], "percent", "mean_db", "sampling")
            axes.set_title(f"{scene}, frames {spacing[scene][1]:g} ms apart")
        chart.label("measurements, % of N", "")
        chart.figure.supylabel("mean PSNR, dB")
    return chart.markdown
