"""Study `stability`, and its faults of taxels and measurements: what is noticed, and the errors."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sparseskin.messages import Measurements, Reconstruction, Taxels
from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING
from sparseskin.nodes.node import Context
from sparseskin.nodes.numerics.arrays import TINY, Floats
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.studies.evaluate import WRONG
from sparseskin.studies.frames import NOISE, SceneFrames
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import Chart, Page, series_style

from . import phase, sweeps

SCENE, FIRST, EVERY = "drag_wrench_40", 400, 5
"""Frames: a wrench that is dragged, at 200 Hz."""
BEFORE, DURING = 100, 100
"""Frames without a fault, and with it."""
RATIO = 3
ROWS = {"fixed": ("sbhe", FIXED), "rotating": ("sbhe", ROTATING), "adaptive": ("adaptive", None)}
"""Rows by name: phi, and rows of the compressor."""
SIGMA, HUM = NOISE.sigma_end, 2 * np.pi * 0.485
"""Noise of an untouched taxel, N; phase that hum of 50 Hz gains per frame at 103 Hz."""
MOST_SILENT = 0.1
"""Share of wrong frames that are trusted, of all, beyond which a fault is named in the caption."""
LEAST = 1.2
"""RMS error of a taxel, in deviations of its noise, up to which no frame is wrong."""


class Fault(NamedTuple):
    """A fault: its name, and a function of the number of frames since it began, the values, those
    of the frames before, and a random generator, which returns the faulty values; `of_taxels`: of
    readings, else of measurements.
    """

    name: str
    apply: Callable[[int, Floats, list[Floats], np.random.Generator], Any]
    of_taxels: bool = False


def _some(y: Floats, rng: np.random.Generator, value: float) -> Floats:
    """Measurements of which one is garbage."""
    return np.where(np.arange(y.size) == rng.integers(y.size), value, y)


def _set(x: Floats, *where: slice) -> Floats:
    """Readings of which some are stuck."""
    stuck = x.copy()
    stuck[where] = 0.8 * PAPER_F_MAX_N
    return stuck


def _top(past: list[Floats]) -> float:
    """Largest measurement before the fault."""
    return float(np.abs(past[BEFORE - 1]).max())


FAULTS = (
    Fault("none", lambda k, y, past, rng: y),
    Fault("one measurement is garbage", lambda k, y, past, rng: _some(y, rng, 50)),
    Fault("one measurement is stuck", lambda k, y, *_: np.where(np.arange(y.size) == 17, 50, y)),
    Fault("all zero", lambda k, y, past, rng: 0 * y),
    Fault("constant", lambda k, y, past, rng: 0 * y + _top(past) / 3),
    Fault("frozen", lambda k, x, past, rng: past[BEFORE - 1], True),
    Fault("dropouts, 30 %", lambda k, y, past, rng: 0 * y if rng.random() < 0.3 else y),
    Fault("noise x 10", lambda k, y, past, rng: y + rng.normal(0, 10 * SIGMA, y.size)),
    Fault("noise x 100", lambda k, y, past, rng: y + rng.normal(0, 100 * SIGMA, y.size)),
    Fault("random", lambda k, y, past, rng: rng.normal(0, np.std(past[-1]), y.size)),
    Fault("pairs out of order", lambda k, y, *_: y[np.minimum(np.arange(y.size) ^ 1, y.size - 1)]),
    Fault("those of the frame before", lambda k, y, past, rng: past[-1]),
    Fault("scaled by 10", lambda k, y, past, rng: 10 * y),
    Fault("clipped to a third", lambda k, y, past, rng: y.clip(-_top(past) / 3, _top(past) / 3)),
    Fault("offset", lambda k, y, past, rng: y + _top(past)),
    Fault("hum of the converter", lambda k, y, past, rng: y + _top(past) / 3 * np.sin(HUM * k)),
    Fault("hum of the taxels", lambda k, x, *_: (x + 20 * SIGMA * np.sin(HUM * k)).clip(0), True),
    Fault("drift of the taxels", lambda k, x, past, rng: x + 0.2 * k * SIGMA, True),
    Fault("stuck row", lambda k, x, past, rng: _set(x, slice(12, 13)), True),
    Fault("stuck column", lambda k, x, past, rng: _set(x, slice(None), slice(25, 26)), True),
    Fault("stuck square", lambda k, x, past, rng: _set(x, slice(8, 16), slice(8, 16)), True),
)


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute the study, write its page and return its conclusion; see `command.Study`."""
    page = Page(out, "stability", Path(__file__).with_name("notes.md"), quick)
    for part in (phase, sweeps):
        part.section(page, quick, seed, executor)
    lines = [section(page, quick, seed, executor)]
    page.write(lines)
    return lines


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Each fault with all kinds of rows."""
    kinds = ("rotating",) if quick else tuple(ROWS)
    return [{"fault": one.name, "rows": rows, "seed": seed} for one in FAULTS for rows in kinds]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Median error of the forces, relative to the true ones; of the frames that are wrong their
    number and the share not trusted; frames until the first of these is not trusted, if one is; of
    those that are not wrong the share not trusted.
    """
    fault = next(one for one in FAULTS if one.name == point["fault"])
    off, norm, trusted = zip(*_frames(fault, point["rows"], point["seed"]), strict=True)
    wrong = np.array(off) > np.maximum(WRONG * np.array(norm), LEAST * SIGMA * math.sqrt(1600))
    told = ~np.array(trusted)
    first = np.flatnonzero(wrong)[:1]
    return {
        "error": float(np.median(np.array(off) / np.maximum(norm, TINY))),
        "n_wrong": int(wrong.sum()),
        "told": float(told[wrong].mean()) if wrong.any() else None,
        "after": int(np.argmax(told[first[0] :])) if told[wrong].any() else None,
        "alarms": float(told[~wrong].mean()) if not wrong.all() else None,
    }


def section(page: Page, quick: bool, seed: int, executor: str) -> str:
    """Compute, draw and add the section; the line of the conclusion."""
    rows = pd.DataFrame(compute_rows(measure, points(quick, seed), page.out, executor, "faults"))
    rows["silent"] = rows["n_wrong"] * (1 - rows["told"].fillna(1).astype(float)) / DURING
    page.csv("faults", rows)
    table = rows.assign(cell=rows.apply(_cell, axis=1)).pivot(
        index="fault", columns="rows", values="cell"
    )
    table = table.loc[[one.name for one in FAULTS], rows["rows"].unique()].reset_index()
    silent = rows[rows["silent"] > MOST_SILENT]
    names = ", ".join(dict.fromkeys(silent["fault"])) or "none"
    chart, counts = _draw(page.out, rows, names), {"before": BEFORE, "during": DURING}
    page.section("Faults of taxels and measurements", chart, table, **counts)
    share = f"more than {MOST_SILENT:.0%} of the frames"
    return f"Faults with wrong forces that are trusted in {share}: {names}."


def _cell(row: pd.Series) -> str:
    """One fault with one kind of rows, as in the table."""
    if not row["n_wrong"]:
        return f"{row['error']:.2f}"
    after = "" if pd.isna(row["after"]) else f", after {row['after']:.0f}"
    return f"{row['error']:.2f}; {row['n_wrong']} wrong, {row['told']:.0%} noticed{after}"


def _draw(out: Path, rows: pd.DataFrame, names: str) -> str:
    """Chart: error of each fault, and share of frames that are wrong and trusted."""
    caption = f"Faults whose wrong forces pass for right ones: {names}."
    faults = [one.name for one in FAULTS]
    with Chart(out, "faults", caption, 2, 2, size_in=(8.5, 6.5), sharey=True) as chart:
        error, silent = chart.panels
        for k, (kind, some) in enumerate(rows.groupby("rows", sort=False)):
            at = some["fault"].map(faults.index) + 0.22 * (k - 1)
            style = series_style(k) | {"linestyle": "none", "markersize": 5}
            error.plot(some["error"], at, label=f"{kind} rows", **style)
            silent.barh(at, 100 * some["silent"], height=0.2, color=style["color"])
        error.axvline(WRONG, color="black", lw=1, ls=":")
        error.set(xscale="log", xlabel="error / true forces (dotted: wrong)")
        error.set_yticks(range(len(faults)), faults)
        error.invert_yaxis()
        silent.set(xlim=(0, 100), xlabel="frames wrong and trusted, %")
    return chart.markdown


def _frames(fault: Fault, rows: str, seed: int) -> Iterator[tuple[float, float, bool]]:
    """Of each frame with a fault: norm of the error and of the true forces, True if trusted."""
    phi, kept = ROWS[rows]
    context, rng = Context("", ManualClock(0), live=False), np.random.default_rng(seed)
    edge = Compressor(Compressor.Settings(phi=phi, rows=kept, ratio=RATIO), context)
    host = Reconstructor(Reconstructor.Settings(), context)
    stop = (BEFORE + DURING) * EVERY
    take = SceneFrames(SCENE, first=FIRST, stop=FIRST + stop, every=EVERY).open(seed)
    skin = take.state(NOISE.sigma_mid, NOISE.sigma_end, 1000 / EVERY)
    for message in (skin, *edge.step(skin)):
        list(host.step(message))
    past: list[Floats] = []
    for k, (truth, taxels) in enumerate(itertools.chain(*take.parts())):

        def faulty(values: Floats, past: list[Floats], k: int = k) -> Floats:
            past.append(values)
            if k < BEFORE:
                return values
            return np.asarray(fault.apply(k - BEFORE, values, past[:-1], rng), dtype=np.float32)

        x = faulty(taxels, past) if fault.of_taxels else taxels
        (message,) = edge.step(Taxels(stamp_ns=k * 10_000_000, patch="skin", forces=x))
        assert isinstance(message, Measurements)
        if not fault.of_taxels:
            message = replace(message, y=faulty(np.asarray(message.y)[0], past)[np.newaxis])
        for found in host.step(message):
            if isinstance(found, Reconstruction) and k >= BEFORE:
                error = np.linalg.norm(found.forces[0] - truth)
                yield float(error), float(np.linalg.norm(truth)), found.trusted[0]
