"""Study `tasks`: what a classifier recognises, by the way the skin is read."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.studies.evaluate import VALUE_BYTES
from sparseskin.studies.frames import digest_of
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import PALETTE, Chart, Page, markdown, series_style

from .classifier import SEARCHED, Classifier, check_installed
from .sets import LabelledFrames, read_set
from .shapes import NAMES, PEAKS_N, SHAPES, SIDE, Presses, draw
from .touch import add as add_first_touch
from .ways import ALL, FORCES, LARGER, SINGLE, SUMS, WAYS, n_bytes

RATIOS = (3, 8, 16, 32, 64)
QUICK_RATIOS = (8, 64)
N_TRAIN = 2400
N_TEST = 1200
QUICK_TRAIN = 360
QUICK_TEST = 120
N_SEEDS = 3
SHAPE_TASK = "shapes"
PLACES_IN_PALETTE = {
    FORCES: 1,
    SUMS: 0,
    LARGER: 2,
    SINGLE: 3,
}
CAPTION = (
    "Share of the test that is recognised over the bytes of a frame: up and to the left is better. "
    "Along each line M is N/64, N/32, N/16, N/8, N/3 (quick: N/64, N/8)"
)


def run(
    out: Path, quick: bool, seed: int, executor: str, data: Path | None = None
) -> list[str]:
    """Compute the study, write its page and return its conclusion; see `command.Study`. `data`:
    folder of a public set of frames, as `read_set` takes it.
    """
    check_installed("study tasks")
    command = "study tasks"
    if quick:
        command += " --quick"
    if data:
        command += " --data DIR"
    page = Page(out, "tasks", Path(__file__).with_name("notes.md"), quick, command)
    n_seeds = 1 if quick else N_SEEDS
    asked = points(quick, seed, n_seeds, {})
    rows = pd.DataFrame(compute_rows(of_shapes, asked, out, executor, "shapes"))
    if data:
        of_set = {"folder": str(data), "digest": _digest(data)}
        asked = points(quick, seed, n_seeds, of_set)
        of_data = pd.DataFrame(compute_rows(of_frames, asked, out, executor, "set"))
        rows = pd.concat([rows, of_data.drop(columns=list(of_set))])

    # The mean over the seeds.
    groups = rows.groupby(["task", "way", "ratio"], sort=False)
    means = groups.mean(numeric_only=True)
    means = means.drop(columns="seed").reset_index()
    opening = {
        "value_bytes": VALUE_BYTES,
        "n_seeds": n_seeds,
        "searched": SEARCHED,
    }
    page.section("", draw_chart(out, means), **opening)
    sizes = {
        "side": SIDE,
        "least_n": PEAKS_N[0],
        "most_n": PEAKS_N[1],
        "names": ", ".join(NAMES),
        "n_labels": len(NAMES),
        "n_train": N_TRAIN,
        "n_test": N_TEST,
    }
    if quick:
        sizes |= {"n_train": QUICK_TRAIN, "n_test": QUICK_TEST}
    page.section("Shapes", *tables(means, SHAPE_TASK), **sizes)
    if data:
        name = next(task for task in means["task"] if task != SHAPE_TASK)
        page.section("A set of frames", *tables(means, name), name=name)
    page.csv("recognised", rows)
    lines = conclusion(means) + add_first_touch(page, quick, seed, executor)
    page.write(lines)
    return lines


def points(
    quick: bool, seed: int, n_seeds: int, of_set: dict[str, str]
) -> list[dict[str, Any]]:
    """A point a way, ratio and seed; `of_set`: fields of a set of frames."""
    ratios = QUICK_RATIOS if quick else RATIOS
    compressed = [way for way in WAYS if way != ALL]
    # All taxels have one ratio.
    pairs = [(ALL, 1)]
    for ratio in ratios:
        pairs += [(way, ratio) for way in compressed]
    return [
        {
            "way": way,
            "ratio": ratio,
            "seed": number,
            "quick": quick,
            **of_set,
        }
        for number in range(seed, seed + n_seeds)
        for way, ratio in pairs
    ]


@lru_cache(maxsize=2)
def _drawn(count: int, seed: int) -> Presses:
    return draw(count, seed)


def of_shapes(point: dict[str, Any]) -> dict[str, Any]:
    """Recognition of presses: accuracy, %; median errors of angle, degrees, and place, taxels."""
    n_train = QUICK_TRAIN if point["quick"] else N_TRAIN
    n_test = QUICK_TEST if point["quick"] else N_TEST
    presses = _drawn(n_train + n_test, point["seed"])
    inputs = WAYS[point["way"]](presses.frames, point["ratio"], point["seed"])
    train = slice(n_train)
    test = slice(n_train, None)

    symmetries = np.array([shape.symmetry for shape in SHAPES.values()])
    orders = symmetries[presses.labels]
    turned = orders * presses.angles
    middle = (SIDE - 1) / 2

    # An angle is a direction of as many turns as the shape looks the same; of a disc there is none.
    directions = np.stack([np.cos(turned), np.sin(turned)], axis=1)
    directions *= (orders > 0)[:, None]
    offsets = (presses.places - middle) / SIDE
    figures = np.hstack([directions, offsets])
    model = Classifier()
    model.fit(inputs[train], presses.labels[train], figures[train])

    shares, estimates = model.predict_all(inputs[test])
    labels = model.classes_[shares.argmax(axis=1)]
    is_right = labels == presses.labels[test]
    places = middle + SIDE * estimates[:, 2:]
    distances = np.linalg.norm(places - presses.places[test], axis=1)
    angles = _angle_errors(estimates[:, :2], turned[test], orders[test])
    return {
        "task": SHAPE_TASK,
        "n_bytes": n_bytes(SIDE * SIDE, point["ratio"]),
        "accuracy": 100 * float(is_right.mean()),
        "angle_deg": float(np.median(angles)),
        "place_taxels": float(np.median(distances)),
    }


def _angle_errors(
    directions: Doubles, turned: Doubles, orders: np.ndarray[Any, Any]
) -> Doubles:
    """Errors of angles, degrees, of the shapes that have one. `directions` (n, 2); `turned`:
    true angle times the order of symmetry `orders`, (n,).
    """
    has_angle = orders > 0
    estimated = np.arctan2(directions[:, 1], directions[:, 0])
    difference = (estimated - turned)[has_angle]
    # Of the angle times its order: a full turn of it is the smallest turn that changes nothing.
    wrapped = np.abs(np.angle(np.exp(1j * difference)))
    errors: Doubles = np.degrees(wrapped / orders[has_angle])
    return errors


@lru_cache(maxsize=1)
def _read(folder: str, digest: str) -> LabelledFrames:
    return read_set(folder)


def of_frames(point: dict[str, Any]) -> dict[str, Any]:
    """Recognition of the labels of a set: accuracy, %, of examples whose groups are not trained."""
    data = _read(point["folder"], point["digest"])
    is_test = data.is_test(point["seed"])
    inputs = WAYS[point["way"]](data.frames, point["ratio"], point["seed"])
    model = Classifier()
    model.fit(inputs[~is_test], data.labels[~is_test])
    shares = model.predict_proba(inputs[is_test])
    labels = model.classes_[shares.argmax(axis=1)]
    is_right = labels == data.labels[is_test]
    return {
        "task": data.name,
        "n_bytes": n_bytes(data.frames[0].size, point["ratio"]),
        "accuracy": 100 * float(is_right.mean()),
    }


def _digest(folder: Path) -> str:
    """Text that changes with the files of a folder: their names, and the content of the first."""
    paths = folder.rglob("*")
    files = sorted(path for path in paths if path.suffix in (".h5", ".npz"))
    names = ""
    for path in files:
        names += f"{path.name} {path.stat().st_size}\n"
    digest = digest_of(files[0]) if files else ""
    return f"{len(files)} {_hash_of(names)} {digest}"


def _hash_of(text: str) -> str:
    """16 hexadecimal characters that change with a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def tables(means: pd.DataFrame, task: str) -> list[str]:
    """A table of accuracy, and of shapes those of angles and places: a row a way."""
    rows = means[means["task"] == task]
    figures = {
        "accuracy": "recognised, %",
        "angle_deg": "median error of the angle, degrees",
        "place_taxels": "median error of the place, taxels",
    }
    texts = []
    for figure, title in figures.items():
        if figure not in rows or rows[figure].isna().all():
            continue
        # A row a way, in the order of `WAYS`, and a column a ratio.
        by_ratio = rows.pivot(
            index="way",
            columns="ratio",
            values=figure,
        )
        by_ratio = by_ratio.reindex([way for way in WAYS if way in by_ratio.index])
        headings = {1: "N"}
        by_ratio.columns = [headings.get(ratio, f"N/{ratio}") for ratio in by_ratio]
        by_ratio.insert(0, title, by_ratio.index)
        # A place is known to a fraction of a taxel.
        digits = ".2f" if figure == "place_taxels" else ".1f"
        formats = dict.fromkeys(by_ratio.columns[1:], digits)
        texts.append(markdown(by_ratio, formats))
    return texts


def conclusion(means: pd.DataFrame) -> list[str]:
    """Of each task: all taxels beside each way, at the most and the fewest bytes."""
    lines = []
    for task, rows in means.groupby("task", sort=False):
        percent = rows.set_index(["way", "ratio"])["accuracy"]
        ratios = sorted(set(rows["ratio"]) - {1})
        texts = []
        for way in WAYS:
            if way != ALL:
                shares = [f"{percent[way, ratio]:.1f}" for ratio in ratios]
                texts.append(f"{way} {' / '.join(shares)}")
        columns = " / ".join(f"N/{ratio}" for ratio in ratios)
        lines.append(
            f"{task}: all taxels {percent[ALL, 1]:.1f} % recognised; "
            f"at {columns}: {'; '.join(texts)}."
        )
    return lines


def draw_chart(out: Path, means: pd.DataFrame) -> str:
    """Chart of accuracy over bytes: a panel a task, a line a way."""
    tasks: Sequence[str] = list(means["task"].unique())
    n = len(tasks)
    size_in = (5.4 * n + 1.2, 4.6)
    layout: dict[str, Any] = {
        "size_in": size_in,
        "legend_columns": 3,
        "sharey": True,
    }
    with Chart(out, "accuracy_over_bytes", CAPTION, n, n, **layout) as chart:
        for axes, task in zip(chart.panels, tasks, strict=True):
            rows = means[means["task"] == task].sort_values("n_bytes")
            _draw_task(axes, rows)
            axes.set_title("twelve shapes" if task == SHAPE_TASK else task)
        chart.label("bytes sent per frame", "recognised, %")
    return chart.markdown


def _draw_task(axes: Axes, rows: pd.DataFrame) -> None:
    """A line a way, and the reading of all taxels as a star on a line across."""
    full = rows[rows["way"] == ALL].iloc[0]
    star = (full["n_bytes"], full["accuracy"])
    black: dict[str, Any] = {"color": PALETTE[-1], "zorder": 1}
    axes.axhline(
        full["accuracy"],
        linestyle="--",
        linewidth=1.0,
        **black,
    )
    axes.plot(
        *star,
        "*",
        label=ALL,
        markersize=11,
        **black,
    )
    for way, place in PLACES_IN_PALETTE.items():
        along = rows[rows["way"] == way]
        style = series_style(place)
        axes.plot(along["n_bytes"], along["accuracy"], label=way, **style)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
