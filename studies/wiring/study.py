"""Study `wiring`: PSNR against the length of the wires, from local to scrambled sums."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.adaptive import layout
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.local import WIRED_BLOCK
from sparseskin.nodes.compressor.phi.rotation import (
    PAPER,
    ROTATING,
    block_and_rule,
    m_of,
    row_subsets,
    rows_and_m,
)
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.compressor.wiring import Wiring, array_wiring, sbhe_wiring
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.solvers.base import make_rotating_solver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.presses import N_BEFORE, press_frames
from sparseskin.studies.evaluate import Estimator, Method, evaluate
from sparseskin.studies.points import compute
from sparseskin.studies.report import Chart, fill_page, frame_of, markdown, series_style, write_csv
from sparseskin.studies.scene_frames import scene_frames

from .readout import ADC_BITS, LOAD_N, ReadRows

SHAPE = (64, 64)
RATIO = 3
SIDES = (4, 6, 8, 12, 16, 24, 32)
LOCAL = tuple(f"local:{side}" for side in SIDES)
ROW_LOCAL, SCRAMBLED, SINGLE = "row_local", "sbhe", "subsample"
KINDS = (*LOCAL, SCRAMBLED, ROW_LOCAL, SINGLE)
DRAG = "drag_wrench_64"
BODIES = ("wrench", "fingertips", "gaussian")
SCENES = (*BODIES, DRAG)
N_FRAMES, QUICK_FRAMES = 120, 15
#: First frame of the scene, when the wrench has landed, and the steps of 0.1 ms between frames.
DRAG_FIRST, DRAG_EVERY = 2400, 20
PRESET_ROWS = {"skin": ROTATING, "paper": PAPER}
CROSSTALK = (0.01, 0.03, 0.1)

Point = dict[str, Any]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the study and write its page; see `command.Study`."""
    seeds = range(seed, seed + (1 if quick else 3))
    scenes = BODIES if quick else SCENES
    n_frames = QUICK_FRAMES if quick else N_FRAMES
    points = [
        {"scene": scene, "seed": one, "n_frames": n_frames} for scene in scenes for one in seeds
    ]
    frame = frame_of(points, compute(accuracy, points, out, executor, "accuracy"), "method")
    frame[["preset", "kind"]] = frame["method"].str.split(" ", expand=True)
    wires = frame_of(
        [{"seed": one} for one in seeds],
        compute(wiring, [{"seed": one} for one in seeds], out, executor, "wires"),
        "kind",
    )
    wires = wires.groupby("kind", sort=False).mean(numeric_only=True).drop(columns="seed")
    frame = frame.join(wires, on="kind")
    circuits = frame_of(points, compute(readout, points, out, executor, "readout"), "circuit")
    best = frame[frame["kind"] == SCRAMBLED].set_index(["preset", "scene", "seed"])["mean_db"]
    keys = list(zip(frame["preset"], frame["scene"], frame["seed"], strict=True))
    frame["loss_db"] = best.loc[keys].to_numpy() - frame["mean_db"].to_numpy()
    fill_page(
        out,
        "wiring",
        conclusion=conclusion(frame),
        n_rows=SHAPE[0],
        n_cols=SHAPE[1],
        ratio=RATIO,
        m=m_of(SHAPE[0] * SHAPE[1], RATIO, ROTATING),
        n_frames=n_frames,
        n_seeds=len(seeds),
        scenes=", ".join(scenes),
        load_n=LOAD_N,
        adc_bits=ADC_BITS,
        chart=_draw(out, frame, scenes),
        table=_table(frame),
        circuits=_circuits(circuits),
        csv=write_csv(out, "wiring", frame.drop(columns="method")),
        csv_readout=write_csv(out, "readout", circuits),
    )


def conclusion(frame: pd.DataFrame) -> list[str]:
    """Loss and length of wires of the shortest neighbourhood, of rows of an array, and of single
    taxels, against rows over the whole skin, with the default solver.
    """
    some = frame[frame["preset"] == "skin"].groupby("kind")[["loss_db", "length"]].mean()
    whole = some.loc[SCRAMBLED, "length"]
    named = {
        LOCAL[0]: f"Rows over neighbourhoods ({LOCAL[0]})",
        ROW_LOCAL: "Rows within the rows of an array",
        SINGLE: "Single taxels",
    }
    return [
        f"{text}: {100 * some.loc[kind, 'length'] / whole:.0f} % of the length of the wires of "
        f"rows over the whole skin, for {some.loc[kind, 'loss_db']:.1f} dB."
        for kind, text in named.items()
    ]


def accuracy(point: Point) -> dict[str, Any]:
    """Reconstruct a scene by each matrix and preset, on the same readings.

    `point`: scene, seed, n_frames.

    Returns
    -------
    dict
        "methods": by "PRESET KIND" mean_db and min_db, mean and least PSNR of contact frames.
    """
    estimators: dict[str, Estimator] = {
        f"{preset} {kind}": method(kind, preset, point["seed"])
        for preset in PRESET_ROWS
        for kind in KINDS
    }
    scores = evaluate(estimators, frames_of(point))
    return {"methods": {of: _figures(one) for of, one in scores.items()}}


def readout(point: Point) -> dict[str, Any]:
    """Reconstruct a scene from sums within rows that stated circuits read; point as above."""

    def made() -> Method:
        return method(ROW_LOCAL, "skin", point["seed"])

    estimators: dict[str, Estimator] = {
        "exact sums": ReadRows(made()),
        "divider, undone": ReadRows(made(), "undone"),
        "divider, taken as linear": ReadRows(made(), "ignored"),
        **{f"crosstalk {100 * c:g} %": ReadRows(made(), crosstalk=c) for c in CROSSTALK},
    }
    scores = evaluate(estimators, frames_of(point))
    return {"methods": {of: _figures(one) for of, one in scores.items()}}


def wiring(point: Point) -> dict[str, Any]:
    """Wires of each matrix. `point`: seed."""
    n, exists = SHAPE[0] * SHAPE[1], np.ones(SHAPE, dtype=np.bool_)
    m = m_of(n, RATIO, ROTATING)
    found: dict[str, Wiring] = {kind: array_wiring(*SHAPE, m) for kind in (ROW_LOCAL, SINGLE)}
    for kind in (*LOCAL, SCRAMBLED):
        phi = make_phi(kind, n, m, point["seed"], WIRED_BLOCK)
        layout(phi, exists)
        assert isinstance(phi, SbhePhi)
        found[kind] = sbhe_wiring(phi, exists)
    return {"methods": {kind: vars(one) for kind, one in found.items()}}


def method(kind: str, preset: str, seed: int) -> Method:
    """A matrix of the study's size with the solver of a preset."""
    rows, n = PRESET_ROWS[preset], SHAPE[0] * SHAPE[1]
    kept, m = rows_and_m(kind, n, rows=rows, ratio=RATIO)
    phi = make_phi(kind, n, m, seed, **block_and_rule(rows, WIRED_BLOCK))
    layout(phi, np.ones(SHAPE, dtype=np.bool_))
    phis = row_subsets(phi, kept)
    chosen = PRESETS[preset]
    settings = {key: value for key, value in chosen.items() if key not in ("solver", "basis")}
    basis = make_basis(chosen["basis"], *SHAPE)
    return Method(make_rotating_solver(chosen["solver"], phis, basis, None, **settings), phis)


def frames_of(point: Point) -> Iterator[tuple[Floats, Floats]]:
    """Yield (truth, taxels) of a point's scene, float32 of shape `SHAPE`, newtons."""
    n_frames, seed = point["n_frames"], point["seed"]
    if point["scene"] == DRAG:
        stop = DRAG_FIRST + n_frames * DRAG_EVERY
        return scene_frames(DRAG, seed, DRAG_FIRST, stop, DRAG_EVERY)
    noise = NoiseModel.for_range(PAPER_F_MAX_N)
    frames = press_frames(point["scene"], SHAPE, N_BEFORE + n_frames, seed, noise=noise)
    return islice(frames, N_BEFORE - 10, None)  # a solver learns the noise of an untouched skin


def _figures(scores: Any) -> dict[str, float]:
    return {"mean_db": scores.mean_db, "min_db": scores.min_db}


def _table(frame: pd.DataFrame) -> str:
    by_kind = frame.groupby("kind", sort=False)
    rows = by_kind[["length", "crossings", "wires_a_taxel", "conversions"]].first()
    rows.insert(0, "kind", rows.index)
    for preset in PRESET_ROWS:
        some = frame[frame["preset"] == preset].groupby("kind", sort=False)
        rows[f"{preset}: mean dB"] = some["mean_db"].mean()
        rows[f"{preset}: loss, dB"] = some["loss_db"].mean()
        rows[f"{preset}: loss, least .. most"] = [
            f"{part['loss_db'].min():.1f} .. {part['loss_db'].max():.1f}" for _, part in some
        ]
    names = {"length": "length, pitches", "wires_a_taxel": "wires a taxel"}
    forms = {
        **{"length, pitches": ",.0f", "crossings": ",.0f", "wires a taxel": ".3f"},
        **{"conversions": ".0f"},
        **{f"{preset}: {what} dB": ".1f" for preset in PRESET_ROWS for what in ("mean", "loss,")},
    }
    return markdown(rows.rename(columns=names), forms)


def _circuits(circuits: pd.DataFrame) -> str:
    found = circuits.groupby(["circuit", "scene"], sort=False)["mean_db"].mean().unstack("scene")
    found = found.reindex(circuits["circuit"].unique())
    found.insert(0, "circuit", found.index)
    return markdown(found, dict.fromkeys(found.columns[1:], ".1f"))


def _draw(out: Path, frame: pd.DataFrame, scenes: tuple[str, ...]) -> str:
    caption = (
        f"Mean PSNR of contact frames against the length of all wires, {SHAPE[0]} x {SHAPE[1]}, "
        f"N/{RATIO}; mean and range over the seeds"
    )
    names = list(PRESET_ROWS)
    with Chart(
        out, "wiring", caption, len(names), len(names), size_in=(10.5, 5.2), sharey=True
    ) as chart:
        for axes, preset in zip(chart.panels, names, strict=True):
            for k, scene in enumerate(scenes):
                some = frame[(frame["preset"] == preset) & (frame["scene"] == scene)]
                along = some.groupby("kind", sort=False).agg(
                    length=("length", "first"),
                    mean=("mean_db", "mean"),
                    low=("mean_db", "min"),
                    high=("mean_db", "max"),
                )
                style = series_style(k)
                line = along.loc[[*LOCAL, SCRAMBLED]]
                axes.fill_between(
                    line["length"], line["low"], line["high"], color=style["color"], alpha=0.15
                )
                axes.plot(line["length"], line["mean"], label=scene, **style)
                for kind, mark in ((ROW_LOCAL, "*"), (SINGLE, "x")):
                    one = along.loc[kind]
                    # Both have the wires of an array: apart, so that both are seen.
                    shift = 0.94 if kind == ROW_LOCAL else 1.06
                    lone = {"color": style["color"], "marker": mark, "linestyle": "", "ms": 8}
                    axes.plot(one["length"] * shift, one["mean"], **lone)
            axes.set_xscale("log")
            lengths = frame.groupby("kind", sort=False)["length"].first()
            shown = ("local:4", "local:8", "local:16", "local:32", SCRAMBLED, ROW_LOCAL)
            names_of = {ROW_LOCAL: "array", SCRAMBLED: "all"}
            axes.set_xticks(
                [float(lengths[kind]) for kind in shown],
                [
                    f"{names_of.get(kind, kind.removeprefix('local:'))}\n{lengths[kind] / 1000:.3g}"
                    for kind in shown
                ],
            )
            axes.set_xticks([], minor=True)
            axes.set_title(f"preset {preset}, rows {PRESET_ROWS[preset]}")
        for mark, label in (("*", "row_local"), ("x", "subsample")):
            chart.panels[0].plot(
                [], [], color="black", marker=mark, linestyle="", ms=8, label=label
            )
        chart.label("side of a neighbourhood\nlength of wires, 1000 pitches (log)", "PSNR, dB")
    return chart.markdown
