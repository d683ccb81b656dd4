"""Study `rates`: what the default solver gains over the paper's, by the frame rate of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.rotation import FIXED, PAPER, ROTATING
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.evaluate import (
    Alone,
    Estimator,
    Method,
    Reading,
    Solved,
    evaluate,
    make_method,
)
from sparseskin.studies.points import compute
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
from sparseskin.studies.scene_frames import first_contact, scene_frames, scene_of, spacing_ms

SCENES = ("drag_wrench_40", "path_40", "drag_wrench_64")
RATES_HZ = (1000, 300, 100, 30)
RATIO = 3
SPAN_S, QUICK_SPAN_S = 3.0, 0.7
#: Untouched time before the first contact, so that a solver has settled.
BEFORE_S = 0.02
#: Weight of the newest reading, and the dead zone, of the filtered full reading.
NEWEST, DEAD_ZONE_N = 0.3, 0.03
#: Standard deviations of its noise by which a reading differs from its mean at a jump.
JUMP_SIGMAS = 4.0

SKIN, ROTATED, ALONE = "skin, N/3", "skin, N/3, rotating", "skin, N/3, each frame alone"
ALL, FILTERED, RAW = "skin, all taxels", "all taxels, filtered", "all taxels, raw"
METHODS = (SKIN, ROTATED, ALL, FILTERED, RAW, ALONE)
DRAWN = (SKIN, ALL, FILTERED, RAW, ALONE)

Point = dict[str, Any]


class Filtered:
    """Estimator of all taxels: their running mean, which begins anew where a reading jumps.

    A taxel jumps where its reading is `JUMP_SIGMAS` standard deviations of the noise, which is
    known to this filter, away from the mean. Means in the dead zone are set to 0.
    """

    def __init__(self, noise: NoiseModel) -> None:
        self._noise = noise
        self._mean: Floats | None = None

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`."""
        if self._mean is None:
            self._mean = taxels.copy()
        change = taxels - self._mean
        jumps = np.abs(change) > JUMP_SIGMAS * self._noise.sigma(self._mean)
        self._mean += np.where(jumps, np.float32(1), np.float32(NEWEST)) * change
        return Solved(np.where(self._mean < DEAD_ZONE_N, np.float32(0), self._mean))


def conclusion(frame: pd.DataFrame) -> list[str]:
    """Means over all scenes, at the highest and the lowest rate."""
    means = frame.groupby(["method", "rate_hz"])[["gain_db", "mean_db"]].mean()
    high, low = frame["rate_hz"].max(), frame["rate_hz"].min()

    def above(method: str, other: str, rate_hz: float) -> str:
        found = means.loc[(method, rate_hz), "mean_db"] - means.loc[(other, rate_hz), "mean_db"]
        return f"{found:+.1f} dB at {rate_hz:g} Hz"

    both = [f"{means.loc[(SKIN, hz), 'gain_db']:+.1f} dB at {hz:g} Hz" for hz in (high, low)]
    return [
        f"Gain of `skin` at N/{RATIO} over preset paper, mean of the scenes: {', '.join(both)}.",
        f"Against the same solver with all taxels: {above(SKIN, ALL, high)}, "
        f"{above(SKIN, ALL, low)}: what compression costs.",
        f"Against a filter of all taxels: {above(SKIN, FILTERED, high)}, "
        f"{above(SKIN, FILTERED, low)}.",
    ]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the study and write its page; see `command.Study`."""
    span_s = QUICK_SPAN_S if quick else SPAN_S
    points = [
        {"scene": scene, "rate_hz": rate_hz, "span_s": span_s, "seed": seed}
        for scene in SCENES
        for rate_hz in RATES_HZ
    ]
    found = compute(at_rate, points, out, executor, "rates")
    frame = frame_of(points, found, "method")
    paper = frame[frame["method"] == PAPER].set_index(["scene", "rate_hz"])["mean_db"]
    frame["gain_db"] = (
        frame["mean_db"]
        - paper.loc[list(zip(frame["scene"], frame["rate_hz"], strict=True))].to_numpy()
    )
    fill_page(
        out,
        "rates",
        conclusion=conclusion(frame),
        ratio=RATIO,
        span_s=span_s,
        jump_sigmas=JUMP_SIGMAS,
        newest=NEWEST,
        dead_zone_n=DEAD_ZONE_N,
        chart=_draw(out, frame),
        gains=_table(frame[frame["method"] != PAPER], "{gain_db:+.1f}"),
        means=_table(frame, "{mean_db:.1f} / {min_db:.1f}"),
        csv=write_csv(out, "methods", frame),
    )


def at_rate(point: Point) -> dict[str, Any]:
    """Reconstruct a scene at a frame rate by each method, on the same readings.

    `point`: scene, rate_hz, span_s, seed.

    Returns
    -------
    dict
        "spacing_ms"; "n_contact", number of contact frames; "methods": by method mean_db and
        min_db, mean and least PSNR of contact frames.
    """
    name, seed = point["scene"], point["seed"]
    scene = scene_of(name)
    step_s = 1e-9 * scene.dt_ns
    every = max(1, round(1 / (point["rate_hz"] * step_s)))
    first = max(0, first_contact(name, seed) - round(BEFORE_S / step_s))
    stop = first + round(point["span_s"] / step_s)

    def method(preset: str, ratio: float, rows: str = FIXED) -> Method:
        return make_method(PRESETS[preset], scene.shape, ratio, seed, rows=rows)

    estimators: dict[str, Estimator] = {
        PAPER: method("paper", RATIO, PAPER),
        SKIN: method("skin", RATIO),
        ROTATED: method("skin", RATIO, ROTATING),
        ALL: method("skin", 1),
        FILTERED: Filtered(NoiseModel.for_range(PAPER_F_MAX_N)),
        RAW: Reading(),
        ALONE: Alone(method("skin", RATIO)),
    }
    scores = evaluate(estimators, scene_frames(name, seed, first, stop, every))
    return {
        "spacing_ms": spacing_ms(name, every),
        "n_contact": len(scores[RAW].contact_db),
        "methods": {
            of: {"mean_db": one.mean_db, "min_db": one.min_db} for of, one in scores.items()
        },
    }


def _table(frame: pd.DataFrame, text: str) -> str:
    rows = frame.assign(
        spacing=cells(frame, "{spacing_ms:.3g} ms"),
        frames=frame["n_contact"],
        cell=cells(frame, text),
    )
    keys = {"scene": "scene", "rate_hz": "rate, Hz", "spacing": "frame spacing", "frames": "frames"}
    return markdown(pivot(rows, list(keys), "method", "cell").rename(columns=keys))


def _draw(out: Path, frame: pd.DataFrame) -> str:
    caption = "Gain of mean PSNR over preset paper at N/3, by frame rate; contact frames"
    size_in = (9.5, 4.4)
    with Chart(
        out,
        "gain",
        caption,
        len(SCENES),
        len(SCENES),
        size_in=size_in,
        legend_columns=3,
        sharey=True,
    ) as chart:
        for axes, scene in zip(chart.panels, SCENES, strict=True):
            some = frame[(frame["scene"] == scene) & frame["method"].isin(DRAWN)]
            draw_lines(axes, some, "rate_hz", "gain_db", "method", DRAWN)
            axes.axhline(0, color="black", linewidth=1.2)
            axes.set_xscale("log")
            # From left to right a body moves further from frame to frame.
            axes.set_xlim(RATES_HZ[0] * 1.25, RATES_HZ[-1] / 1.25)
            axes.set_xticks(RATES_HZ, [f"{rate}\n{1000 / rate:.3g}" for rate in RATES_HZ])
            axes.set_xticks([], minor=True)
            axes.set_title(scene)
        chart.label("frame rate, Hz\nframe spacing, ms", "gain over paper, dB")
    return chart.markdown
