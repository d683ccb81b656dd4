"""Study `design-grid`: the grid of simulations from which `design` states accuracy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.studies.points import Figures, StudyError, compute
from sparseskin.studies.report import Chart, fill_page, markdown, series_style, write_csv

from .grid import (
    Axes,
    Grid,
    base_cells,
    made_grid,
    narrow_cells,
    rate_cells,
    touch_cells,
    write_grid,
)
from .simulation import SPEED, scene_accuracy, touch_accuracy
from .strategies import STRATEGIES

AXES = Axes(
    sides=(8, 16, 20, 32, 64),
    noise=(0.001, 0.003, 0.01, 0.03),
    rate_hz=100.0,
    bits=16,
    n_scenes=6,
    rate_sides=(16, 64),
    rate_noise=(0.003, 0.03),
    rates_hz=(30.0, 300.0, 1000.0),
    rate_scenes=3,
    touch_sides=(8, 16, 32, 64),
    touch_noise=(0.01,),
    narrow_sides=(16, 32),
    narrow_noise=(0.003, 0.03),
    narrow=4,
)
QUICK_AXES = Axes(
    sides=(8, 16),
    noise=(0.003, 0.03),
    rate_hz=100.0,
    bits=16,
    n_scenes=2,
    rate_sides=(8, 16),
    rate_noise=(0.003, 0.03),
    rates_hz=(30.0,),
    rate_scenes=1,
    touch_sides=(8, 16),
    touch_noise=(0.03,),
    narrow_sides=(8,),
    narrow_noise=(0.03,),
    narrow=4,
)
#: Shape, noise, bits and rate of points between those of the grid.
HELD_OUT = (
    ((24, 24), 0.0055, 16, 100.0),
    ((48, 48), 0.0017, 12, 100.0),
    ((12, 32), 0.017, 8, 100.0),
    ((24, 24), 0.0017, 8, 100.0),
    ((48, 48), 0.017, 10, 50.0),
    ((48, 48), 0.0055, 8, 170.0),
    ((12, 32), 0.004, 10, 200.0),
    ((8, 48), 0.0055, 12, 100.0),
    ((48, 12), 0.0055, 12, 100.0),
    ((10, 20), 0.005, 12, 80.0),
    ((20, 28), 0.0055, 10, 600.0),
)
#: How many of them are searched for the light touch, too.
HELD_OUT_TOUCHES = 3
QUICK_HELD_OUT = (((12, 12), 0.01, 8, 50.0),)

Point = dict[str, Any]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the grid, measure its interpolation error, and write both; see `command.Study`."""
    axes, held = (QUICK_AXES, QUICK_HELD_OUT) if quick else (AXES, HELD_OUT)
    held_cells: list[Point] = [
        {"shape": list(shape), "noise": noise, "bits": bits, "rate_hz": rate_hz}
        for shape, noise, bits, rate_hz in held
    ]

    def scenes(label: str, cells: list[Point], n_scenes: int) -> list[list[Figures]]:
        """Figures of each cell's scenes, by strategy."""
        points = [{**cell, "scene": k, "seed": seed} for cell in cells for k in range(n_scenes)]
        found = compute(scene_accuracy, points, out, executor, label)
        return [found[k : k + n_scenes] for k in range(0, len(found), n_scenes)]

    def touches(label: str, cells: list[Point]) -> list[Figures]:
        keys = ("shape", "noise", "bits")
        points = [{**{key: cell[key] for key in keys}, "seed": seed} for cell in cells]
        return compute(touch_accuracy, points, out, executor, label)

    base = scenes("scenes", base_cells(axes), axes.n_scenes)
    touched = touches("touches", touch_cells(axes))
    rates = scenes("rates", rate_cells(axes), axes.rate_scenes)
    narrow = scenes("shapes", narrow_cells(axes), axes.rate_scenes)
    held_scenes = scenes("held out", held_cells, axes.n_scenes)
    held_touched = touches("touches held out", held_cells[:HELD_OUT_TOUCHES])
    held_touched += [{}] * (len(held_cells) - len(held_touched))

    grid = made_grid(axes, base, rates, narrow, touched)
    errors = held_out_errors(grid, held_cells, held_scenes, held_touched)
    worst = errors.groupby("strategy")[["error_db", "touch_factor"]].agg(_largest)
    tables = {
        name: replace(
            table,
            error_db=float(worst.loc[name, "error_db"]),
            touch_error=float(worst.loc[name, "touch_factor"]),
        )
        for name, table in grid.tables.items()
    }
    grid = Grid(axes, tables)
    path = out / "grid.json"
    try:
        write_grid(path, grid)
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror}") from error
    write_page(out, grid, errors)
    inside = errors["inside"].mean()
    print(
        f"interpolation error at {len(held)} points held out: "
        f"{errors['error_db'].abs().mean():.1f} dB in the mean, "
        f"{errors['error_db'].abs().max():.1f} dB at most; "
        f"{100 * inside:.0f} % of their scenes within the band; "
        f"light touch within a factor of {worst['touch_factor'].max():.2f}"
    )
    oblong = [cell["shape"][0] != cell["shape"][1] for cell in held_cells for _ in STRATEGIES]
    if any(oblong):
        plain = {name: replace(t, narrow_db=0 * t.narrow_db) for name, t in grid.tables.items()}
        as_squares = held_out_errors(Grid(axes, plain), held_cells, held_scenes, held_touched)
        with_shape, without = (one["error_db"][oblong].abs().mean() for one in (errors, as_squares))
        print(
            f"on skins that are not square: {with_shape:.1f} dB in the mean; {without:.1f} dB "
            "without the effect of the shape"
        )


def held_out_errors(
    grid: Grid,
    cells: Sequence[Point],
    scenes: Sequence[Sequence[Figures]],
    touches: Sequence[Figures],
) -> pd.DataFrame:
    """Figures of the grid beside simulated ones: a row a cell and strategy.

    `cells`, `scenes` and `touches` are as in `made_grid`; cells without touches have an empty one.

    Columns: taxels, noise, bits, rate, strategy, simulated_db, grid_db, error_db, inside (part of
    the scenes within the band without the interpolation error), simulated_touch, grid_touch and
    touch_factor (1 or more; NaN where one of them is not found).
    """
    rows = []
    for cell, of_scenes, of_touch in zip(cells, scenes, touches, strict=True):
        n_taxels = math.prod(cell["shape"])
        aspect = cell["shape"][1] / cell["shape"][0]
        conditions = (n_taxels, cell["noise"], cell["bits"], cell["rate_hz"], aspect)
        for name in STRATEGIES:
            dbs = np.array([scene[name][0] for scene in of_scenes])
            found = grid.at(name, *conditions)
            if found is None:
                raise StudyError(f"held out: {conditions} lies outside the grid")
            touch = of_touch.get(name) or math.nan
            factor = found.touch / touch
            rows.append(
                {
                    "taxels": f"{cell['shape'][0]} x {cell['shape'][1]}",
                    "noise": cell["noise"],
                    "bits": cell["bits"],
                    "rate": cell["rate_hz"],
                    "strategy": name,
                    "simulated_db": float(dbs.mean()),
                    "grid_db": found.db,
                    "error_db": found.db - float(dbs.mean()),
                    "inside": float(np.mean((dbs >= found.low_db) & (dbs <= found.high_db))),
                    "simulated_touch": touch,
                    "grid_touch": found.touch,
                    "touch_factor": max(factor, 1 / factor),
                }
            )
    return pd.DataFrame(rows)


def write_page(out: Path, grid: Grid, errors: pd.DataFrame) -> None:
    """Write the page, its charts and tables."""
    axes = grid.axes
    by_strategy = errors.groupby("strategy", sort=False)
    summary = pd.DataFrame(
        {
            "strategy": list(STRATEGIES),
            "mean error, dB": by_strategy["error_db"].mean().to_numpy(),
            "largest error, dB": by_strategy["error_db"].agg(_largest).to_numpy(),
            "scenes within the band, %": 100 * by_strategy["inside"].mean().to_numpy(),
            "light touch, largest factor": by_strategy["touch_factor"].max().to_numpy(),
        }
    )
    middle = axes.noise[len(axes.noise) // 2]
    fill_page(
        out,
        "design-grid",
        Path(__file__).with_name("page.md"),
        axes=axes,
        speed=SPEED,
        chart=_draw(out, grid),
        accuracy=_at_noise(grid, middle),
        middle=100 * middle,
        rates=_rates(grid),
        shapes=_shapes(grid),
        touches=_touches(grid),
        held_out=markdown(
            errors.pivot_table(
                "error_db", ["taxels", "noise", "bits", "rate"], "strategy", sort=False
            ).reset_index(),
            dict.fromkeys(STRATEGIES, "+.1f"),
        ),
        summary=markdown(summary, dict.fromkeys(summary.columns[1:], ".1f")),
        csv=write_csv(out, "held_out", errors),
    )


def _largest(values: pd.Series) -> float:
    return float(values.abs().max())


def _at_noise(grid: Grid, noise: float) -> str:
    """PSNR and its band by skin at one noise."""
    k = grid.axes.noise.index(noise)
    rows = [
        {
            "strategy": name,
            **{
                f"{side} x {side}": f"{table.db[i, k]:.1f} "
                f"({table.low_db[i, k]:.1f}..{table.high_db[i, k]:.1f})"
                for i, side in enumerate(grid.axes.sides)
            },
        }
        for name, table in grid.tables.items()
    ]
    return markdown(pd.DataFrame(rows))


def _rates(grid: Grid) -> str:
    """Effect of the rate by skin, noise in turn."""
    axes = grid.axes
    rows = [
        {
            "strategy": name,
            **{
                f"{side} x {side}, {rate:g} Hz": " / ".join(
                    f"{table.rate_db[i, k, axes.all_rates_hz.index(rate)]:+.1f}"
                    for k in range(len(axes.rate_noise))
                )
                for i, side in enumerate(axes.rate_sides)
                for rate in axes.rates_hz
            },
        }
        for name, table in grid.tables.items()
    ]
    return markdown(pd.DataFrame(rows))


def _shapes(grid: Grid) -> str:
    """Effect of a narrow shape by its taxels, noise in turn."""
    axes = grid.axes
    rows = [
        {
            "strategy": name,
            **{
                f"{side * side} taxels, {shape}": " / ".join(
                    f"{one:+.1f}" for one in table.narrow_db[i, :, j]
                )
                for i, side in enumerate(axes.narrow_sides)
                for j, shape in ((0, f"{axes.narrow} : 1"), (2, f"1 : {axes.narrow}"))
            },
        }
        for name, table in grid.tables.items()
    ]
    return markdown(pd.DataFrame(rows))


def _touches(grid: Grid) -> str:
    """Light touch in units of the noise by skin, noise in turn."""
    rows = [
        {
            "strategy": name,
            **{
                f"{side} x {side}": " / ".join(f"{one:.1f}" for one in table.touch[i])
                for i, side in enumerate(grid.axes.touch_sides)
            },
        }
        for name, table in grid.tables.items()
    ]
    return markdown(pd.DataFrame(rows))


def _draw(out: Path, grid: Grid) -> str:
    axes = grid.axes
    caption = (
        f"Mean PSNR of contact frames against the noise, at {axes.rate_hz:g} Hz; a panel a skin"
    )
    with Chart(
        *(out, "grid", caption, len(axes.sides), 2),
        size_in=(8.5, 8.0),
        legend_columns=3,
        sharex=True,
        sharey=True,
    ) as chart:
        for i, (panel, side) in enumerate(zip(chart.panels, axes.sides, strict=True)):
            for k, (name, table) in enumerate(grid.tables.items()):
                noise = 100 * np.array(axes.noise)
                panel.plot(noise, table.db[i], label=STRATEGIES[name].name, **series_style(k))
            panel.set_xscale("log")
            panel.set_xticks(noise, [f"{one:g}" for one in noise])
            panel.set_xticks([], minor=True)
            panel.set_title(f"{side} x {side} taxels")
        chart.label("noise, % of the range (log)", "PSNR, dB")
    return chart.markdown
