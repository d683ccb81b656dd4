"""Study `layouts`: skins of points, beside the grid where there is one and beside other ways."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.rotation import FIXED, PAPER
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.sensor.layouts.files import EXAMPLE, load_points
from sparseskin.nodes.sensor.layouts.placing import Placement, place
from sparseskin.nodes.sensor.layouts.points import Points
from sparseskin.nodes.sensor.layouts.scenes import SCENES, PointScene
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.presses import press_frames
from sparseskin.studies.evaluate import Estimator, Reading, evaluate, make_method
from sparseskin.studies.points import compute
from sparseskin.studies.report import cells, fill_page, frame_of, markdown, pivot, write_csv

from .ways import BISECTED, IN_ORDER, PLACED, WAYS, OnGrid, placed_by, shuffled

SIDES, REMOVED = (40, 64), (0.1, 0.2, 0.3)
BODIES = ("plate", "wrench", "gaussian")
RATIOS = (3, 8)
LAYOUTS = ("torso", "grip", "triangles")
N_FRAMES, N_SCENE_FRAMES = 80, 150
QUICK_FRAMES = 40
N_DRAWS = 3
#: Seeds of scene, noise and Phi: with another Phi alone, PSNR differs by 1 dB (standard deviation).
SPEED, TOUCHED, PITCH_M = 0.25, 0.1, 0.005
GRID = "grid"
NOISE = NoiseModel.for_range(PAPER_F_MAX_N)

Point = dict[str, Any]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the study and write its page; see `command.Study`."""
    n_frames = QUICK_FRAMES if quick else N_FRAMES
    grids = [
        {
            "side": side,
            "removed": removed,
            "body": body,
            "ratio": ratio,
            "n_frames": n_frames,
            "seed": seed + draw,
        }
        for side in (SIDES[:1] if quick else SIDES)
        for removed in (REMOVED[1:2] if quick else REMOVED)
        for body in (BODIES[1:2] if quick else BODIES)
        for ratio in RATIOS
        for draw in range(1 if quick else N_DRAWS)
    ]
    scenes = [
        {
            "layout": layout,
            "scene": scene,
            "ratio": ratio,
            "n_frames": QUICK_FRAMES if quick else N_SCENE_FRAMES,
            "seed": seed + draw,
        }
        for layout in (LAYOUTS[1:2] if quick else LAYOUTS)
        for scene in SCENES
        for ratio in RATIOS
        for draw in range(1 if quick else N_DRAWS)
    ]
    on_grid = frame_of(grids, compute(grid_figures, grids, out, executor, "grids"), "way")
    on_points = frame_of(scenes, compute(scene_figures, scenes, out, executor, "scenes"), "way")
    fill_page(
        out,
        "layouts",
        conclusion=conclusion(on_grid),
        n_frames=n_frames,
        n_draws=1 if quick else N_DRAWS,
        n_scene_frames=scenes[0]["n_frames"],
        speed=SPEED,
        touched=100 * TOUCHED,
        grids=_grids(on_grid),
        layouts=_layouts(on_points),
        grids_csv=write_csv(out, "grids", on_grid),
        scenes_csv=write_csv(out, "scenes", on_points),
    )


def conclusion(frame: pd.DataFrame) -> list[str]:
    """Loss against the grid in the mean, and its standard error, of each preset."""
    lines = []
    for preset in ("paper", "skin"):
        keys = ["side", "removed", "body", "ratio", "seed"]
        by_way = frame.pivot(index=keys, columns="way", values=preset)
        loss = by_way[GRID] - by_way[PLACED]
        means = loss.groupby(["side", "removed", "ratio"]).mean()
        error = loss.sem() if len(loss) > 1 else 0.0
        lines.append(
            f"Preset {preset}: points without knowledge of the grid lose {loss.mean():.2f} dB "
            f"(standard error {error:.2f}) against the grid in the mean over {len(loss)} cases, "
            f"at most {means.max():.2f} dB in a row of the table; bisected "
            f"{(by_way[GRID] - by_way[BISECTED]).mean():.2f} dB, in file order "
            f"{(by_way[GRID] - by_way[IN_ORDER]).mean():.2f} dB."
        )
    return lines


def grid_points(side: int, mask: Mask) -> Points:
    """Points of the cells of a grid that exist, in row-major order."""
    rows, cols = np.nonzero(mask)
    places = np.stack([PITCH_M * cols, -PITCH_M * rows, np.zeros(rows.size)], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (rows.size, 1))
    return Points("grid", places, normals, np.arange(rows.size), rows.size)


def grid_figures(point: Point) -> dict[str, Any]:
    """PSNR of a grid with cells removed, and of its taxels as points, by each way.

    `point`: side, removed (part of the cells), body, ratio, n_frames, seed.

    Returns
    -------
    dict
        By way (and "grid") paper and skin, mean PSNR of contact frames, dB; raw, that of the
        reading of all taxels.
    """
    side, seed = point["side"], point["seed"]
    rng = np.random.default_rng([seed, 7])
    mask = rng.random((side, side)) >= point["removed"]
    points = grid_points(side, mask)
    moved, order = shuffled(points, seed)
    frames = [
        (truth[mask][:, None], taxels[mask][:, None])
        for truth, taxels in press_frames(
            point["body"],
            (side, side),
            point["n_frames"],
            seed,
            speed=SPEED,
            active=TOUCHED,
            mask=mask,
            noise=NOISE,
        )
    ]
    placements = {way: placed_by(way, points) for way in (BISECTED, IN_ORDER)}
    placements[GRID] = Placement(points, (side, side), np.flatnonzero(mask), PITCH_M)
    # Placed are the points in any order and turned, as a file might have them.
    found = place(moved)
    back = np.argsort(order)
    placements[PLACED] = Placement(points, found.shape, found.cells[back], found.pitch_m)
    return _scores(placements, frames, point)


def scene_figures(point: Point) -> dict[str, Any]:
    """PSNR of a scene on points by each way.

    `point`: layout, scene, ratio, n_frames, seed. Returns as `grid_figures` does.
    """
    points = load_points(EXAMPLE + point["layout"])
    placements = {way: placed_by(way, points) for way in WAYS}
    return _scores(placements, list(_scene_frames(placements[PLACED], point)), point)


def _scene_frames(placement: Placement, point: Point) -> Iterator[tuple[Floats, Floats]]:
    """True forces and readings of all points, (n, 1) each."""
    rng = np.random.default_rng(point["seed"])
    scene = PointScene(point["scene"], placement, point["seed"])
    for _, image in islice(scene, point["n_frames"]):
        truth = image.reshape(-1)[placement.cells][:, None]
        yield truth, NOISE.apply(truth, rng)


def _scores(
    placements: dict[str, Placement], frames: list[tuple[Floats, Floats]], point: Point
) -> dict[str, dict[str, float]]:
    estimators: dict[str, Estimator] = {"raw": Reading()}
    for way, placement in placements.items():
        mask = placement.skin(PAPER_F_MAX_N, "N").exists
        for preset, rows in (("paper", PAPER), ("skin", FIXED)):
            method = make_method(
                PRESETS[preset], mask.shape, point["ratio"], point["seed"], rows=rows, mask=mask
            )
            estimators[f"{way} {preset}"] = OnGrid(method, placement)
    scores = evaluate(estimators, frames)
    return {
        way: {
            "raw": scores["raw"].mean_db,
            **{preset: scores[f"{way} {preset}"].mean_db for preset in ("paper", "skin")},
        }
        for way in placements
    }


def _grids(frame: pd.DataFrame) -> str:
    """PSNR of paper and skin by side and removed cells: a column a way, mean over bodies."""
    keys = ["side", "removed", "ratio"]
    means = frame.groupby([*keys, "way"], sort=False)[["paper", "skin"]].mean().reset_index()
    means = means.assign(cell=cells(means, "{paper:.1f} / {skin:.1f}"))
    table = pivot(means, keys, "way", "cell")[[*keys, GRID, *WAYS]]
    table["side"] = cells(table, "{side} x {side}")
    table["removed"] = cells(table, "{removed:.0%}")
    table["ratio"] = cells(table, "N/{ratio}")
    return markdown(table.rename(columns={"side": "grid of", "ratio": "M"}))


def _layouts(frame: pd.DataFrame) -> str:
    keys = ["layout", "scene", "ratio"]
    means = frame.groupby([*keys, "way"], sort=False)[["paper", "skin"]].mean().reset_index()
    means = means.assign(cell=cells(means, "{paper:.1f} / {skin:.1f}"))
    table = pivot(means, keys, "way", "cell")
    raw = frame.groupby(keys, sort=False)["raw"].mean()
    table.insert(3, "raw reading", [f"{db:.1f}" for db in raw])
    table["ratio"] = cells(table, "N/{ratio}")
    return markdown(table.rename(columns={"ratio": "M"}))
