"""Study `moving`: bodies that move far from frame to frame, ramps, and sudden contacts."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.rotation import FIXED, PAPER, ROTATING, m_of
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.presses import BODIES, COURSES, press_frames
from sparseskin.studies.evaluate import (
    Estimator,
    Method,
    Reading,
    Scores,
    evaluate,
    make_method,
)
from sparseskin.studies.points import compute
from sparseskin.studies.real.methods import ADAPTIVE, Skin, adaptive_values
from sparseskin.studies.report import (
    Chart,
    cells,
    draw_lines,
    fill_page,
    frame_of,
    markdown,
    pivot,
    write_csv,
)

from .sizes import ACTIVE, SIZES, VANISHED, sized

SIDES = (40, 64)
RATIOS = (3, 4, 8)
#: Taxels a frame, and part of the skin that a body touches.
SPEED, TOUCHED = 0.25, 0.1
N_FRAMES = 160
QUICK_BODIES = ("wrench", "peg")
QUICK_SIZES = ("4 x 4", "10 x 10")

RAW, SKIN, ROTATED = "raw reading", "skin", f"skin, {ROTATING}"
METHODS = (PAPER, SKIN, ROTATED)
#: Methods on bodies that move: smaller skins may have too few measurements for the last one.
MOVED = (*METHODS, ADAPTIVE)

NOISE = NoiseModel.for_range(PAPER_F_MAX_N)

Point = dict[str, Any]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the study and write its page; see `command.Study`."""
    points = [
        {"side": side, "course": course, "body": body, "ratio": ratio, "seed": seed}
        for side in SIDES
        for course in COURSES
        for body in (QUICK_BODIES if quick else BODIES)
        for ratio in RATIOS
    ]
    sizing = [
        {"skin": skin, "active": active, "ratio": ratio, "seed": seed}
        for skin in (QUICK_SIZES if quick else SIZES)
        for active in ACTIVE
        for ratio in RATIOS
        if _allows(skin, ratio)
    ]
    sizes = frame_of(sizing, compute(sized, sizing, out, executor, "sizes"), "method")
    frame = frame_of(points, compute(pressed, points, out, executor, "presses"), "method")
    keys = ["side", "course", "ratio", "method"]
    means = frame.groupby(keys, sort=False)[["mean_db", "first_db"]].mean().reset_index()
    fill_page(
        out,
        "moving",
        conclusion=conclusion(means),
        speed=SPEED,
        active=100 * TOUCHED,
        sizes=_sizes(sizes),
        sizes_csv=write_csv(out, "sizes", sizes),
        actives=" / ".join(f"{100 * part:g}" for part in ACTIVE),
        vanished=100 * VANISHED,
        n_frames=N_FRAMES,
        chart=_draw(out, means),
        overall=_table(means, ["side"], "mean_db"),
        courses=_table(means, ["side", "course"], "mean_db"),
        first=_table(means, ["side", "course"], "first_db"),
        bodies=_table(frame, ["side", "course", "body"], "mean_db"),
        csv=write_csv(out, "methods", frame),
    )


def conclusion(means: pd.DataFrame) -> list[str]:
    """Means of each course over both sizes, at the smallest ratio N / M."""
    some = means[means["ratio"] == means["ratio"].min()]
    found = some.groupby(["course", "method"])["mean_db"].mean()

    def shown(course: str, method: str) -> str:
        known = (course, method) in found.index
        return f"{method} {found[course, method]:.1f} dB" if known else f"{method} -"

    return [
        f"*{course}*, N/{some['ratio'].min():g}: "
        f"{', '.join(shown(course, method) for method in (ROTATED, SKIN, PAPER, RAW))}."
        for course in some["course"].unique()
    ]


def pressed(point: Point) -> dict[str, Any]:
    """Reconstruct presses by each method at one ratio N / M, on the same readings.

    `point`: side, course, body, ratio, seed.

    Returns
    -------
    dict
        "methods": by method mean_db and min_db, mean and least PSNR of contact frames, and
        first_db, the mean of the first frames of contacts.
    """
    side, ratio, seed = point["side"], point["ratio"], point["seed"]
    shape = (side, side)
    estimators: dict[str, Estimator] = {
        RAW: Reading(),
        PAPER: make_method(PRESETS["paper"], shape, ratio, seed, rows=PAPER),
        SKIN: make_method(PRESETS["skin"], shape, ratio, seed, rows=FIXED),
        ROTATED: make_method(PRESETS["skin"], shape, ratio, seed, rows=ROTATING),
        ADAPTIVE: _adaptive(shape, ratio, seed),
    }
    frames = press_frames(
        point["body"],
        shape,
        N_FRAMES,
        seed,
        course=point["course"],
        speed=SPEED,
        active=TOUCHED,
        noise=NOISE,
    )
    scores = evaluate(estimators, frames)
    return {
        "methods": {
            name: {"mean_db": one.mean_db, "min_db": one.min_db, "first_db": first_db(one)}
            for name, one in scores.items()
        }
    }


def _adaptive(shape: tuple[int, int], ratio: int, seed: int) -> Method:
    """Make the method of adaptive rows that sends no more bytes than the others."""
    skin = Skin(np.ones(shape, dtype=np.bool_), PAPER_F_MAX_N)
    m = adaptive_values(skin, m_of(skin.n, ratio))
    return make_method(
        PRESETS["skin"],
        shape,
        # M is rounded down: a half keeps it from rounding errors.
        skin.n / (m + 0.5),
        seed,
        rows=FIXED,
        phi="adaptive",
        sigma_end=NOISE.sigma_end,
    )


def first_db(scores: Scores) -> float:
    """Mean PSNR of the frames in contact whose last one was not, dB."""
    touches = [False, *scores.contact]
    first = [now and not before for before, now in pairwise(touches)]
    return float(np.mean(np.array(scores.psnr_db)[first]))


def _table(frame: pd.DataFrame, keys: list[str], value: str) -> str:
    """PSNR of the raw reading, and by ratio those of the other methods, in the mean."""
    means = frame.groupby([*keys, "ratio", "method"], sort=False)[value].mean().reset_index()
    raw = means[means["method"] == RAW].groupby(keys, sort=False)[value].first()
    some = means[means["method"] != RAW]
    some = some.assign(cell=cells(some, f"{{{value}:.1f}}"), M=cells(some, "N/{ratio}"))
    rows = some.groupby([*keys, "method"], sort=False)["cell"].agg(" / ".join).reset_index()
    table = pivot(rows, keys, "method", "cell")
    table.insert(len(keys), RAW, [f"{db:.1f}" for db in raw])
    table["side"] = cells(table, "{side} x {side}")
    return markdown(table.rename(columns={"side": "taxels"}))


def _allows(skin: str, ratio: int) -> bool:
    """True if a skin has a taxel for each of N / M."""
    shape, n_scattered = SIZES[skin]
    return (n_scattered or math.prod(shape)) >= ratio


def _sizes(sizes: pd.DataFrame) -> str:
    """Errors by skin, part touched and method: a row a skin and ratio, in the mean of the parts."""
    # A method is named "skin", too.
    sizes = sizes.rename(columns={"skin": "taxels"})
    keys = ["taxels", "ratio", "method"]
    means = sizes.groupby(keys, sort=False)[["median", "vanished"]].mean().reset_index()
    means = means.assign(cell=cells(means, "{median:.0f} / {vanished:.0f}"))
    table = pivot(means, keys[:2], "method", "cell")
    table["ratio"] = cells(table, "N/{ratio}")
    return markdown(table.rename(columns={"ratio": "M"}))


def _draw(out: Path, means: pd.DataFrame) -> str:
    caption = "Mean PSNR above that of the raw reading of all taxels; contact frames"
    n_panels = len(SIDES) * len(COURSES)
    keys = ["side", "course", "ratio"]
    raw = means[means["method"] == RAW].set_index(keys)["mean_db"]
    above = means[means["method"] != RAW]
    above = above.assign(
        above_db=above["mean_db"].to_numpy()
        - raw.loc[pd.MultiIndex.from_frame(above[keys])].to_numpy()
    )
    with Chart(
        out, "above", caption, n_panels, len(COURSES), size_in=(9.0, 6.2), sharex=True, sharey=True
    ) as chart:
        panels = ((side, course) for side in SIDES for course in COURSES)
        for axes, (side, course) in zip(chart.panels, panels, strict=True):
            some = above[(above["side"] == side) & (above["course"] == course)]
            some = some.assign(place=[RATIOS.index(ratio) for ratio in some["ratio"]])
            draw_lines(axes, some, "place", "above_db", "method", MOVED)
            axes.axhline(0, color="black", linewidth=1.2)
            axes.set_xticks(range(len(RATIOS)), [f"N/{ratio}" for ratio in RATIOS])
            axes.set_title(f"{course}, {side} x {side}")
        chart.label("measurements a frame", "above the raw reading, dB")
    return chart.markdown
