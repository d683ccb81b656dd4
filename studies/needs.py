"""Study `scene-needs`: scenes with a degree of freedom or a term more or less, and their frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.bodies import (
    Body,
    metal_peg,
    monkey_wrench,
    wooden_cube,
)
from sparseskin.nodes.sensor.scenes.scenes import SCENES, SKIN_ON_GROUND, TAXEL_RADIUS_M
from sparseskin.nodes.sensor.scenes.simulation import (
    SMOOTHING_STEPS,
    MovingAverage,
    Scene,
    SceneSource,
)
from sparseskin.nodes.touch import in_contact

from .points import compute_rows
from .report import PALETTE, Chart, Page, cells

QUICK_SCENES = ("lift_box_40", "lift_wrench_40", "path_40")
QUICK_STEPS = 1000
OFTEN = 0.05
"""Share of frames changed by more than their noise above which a scene is another one."""
FINER = 10
BODIES: tuple[Callable[[float], Body], ...] = (wooden_cube, metal_peg, monkey_wrench)
#: Reasons for which a scene keeps what it does not need.
KEPT = {
    "round taxels": "the skin is one and the same in all scenes",
    "damping of the ground": "the ground is one and the same in all scenes",
    "damping of the skin": "the skin is one and the same in all scenes",
    "moving average": "the recordings of the paper are smoothed; felt at the impact alone",
}
#: Reasons for which a scene does without what it would need.
LEFT_OUT = {
    ("path_40", axis): "the peg is kept vertical, as in the paper"
    for axis in ("pitch", "roll", "pitch and roll")
}


@dataclass(frozen=True)
class Variant:
    """One way to change a scene: what it has is removed (`carried`), or something is added; width
    of the moving average; steps of the simulation for one frame.
    """

    carried: bool
    scene: Scene
    smoothing_steps: int = SMOOTHING_STEPS
    finer: int = 1

    def frames(self) -> Iterator[Floats]:
        """True forces in N, float32 of shape (n_rows, n_cols), one for each frame."""
        average = MovingAverage(self.smoothing_steps, self.scene.shape)
        f_max_n = np.float32(self.scene.f_max_n)
        source = SceneSource(self.scene, seed=0)
        for step, state in enumerate(source.states()):
            # Of finer steps, those at the times of the scene's own.
            if step % self.finer == 0:
                state.write_forces(average.newest)
                yield np.minimum(average.step(), f_max_n)


def variants(scene: Scene) -> dict[str, Variant]:
    """All variants of a scene, by name."""
    surface = scene.surface
    grounded = surface.ground_drop_m is not None
    # The same body under taxels without a radius.
    needles = next(body(0.0) for body in BODIES if body(TAXEL_RADIUS_M) is scene.body)
    other_ground = SKIN_ON_GROUND
    if grounded:
        other_ground = replace(surface, ground_drop_m=None)
    # The same time in more steps.
    in_finer_steps = replace(
        scene,
        n_steps=FINER * scene.n_steps,
        dt_ns=scene.dt_ns // FINER,
    )
    finer = Variant(False, in_finer_steps, finer=FINER)
    undamped = replace(surface, damping=0.0)
    variants = {
        "damping of the skin": Variant(True, replace(scene, surface=undamped)),
        "round taxels": Variant(True, replace(scene, body=needles)),
        "moving average": Variant(True, scene, smoothing_steps=1),
        "pitch": _with_or_without(scene, "pitch"),
        "roll": _with_or_without(scene, "roll"),
        "ground": Variant(grounded, replace(scene, surface=other_ground)),
        "steps a tenth as long": finer,
    }
    if grounded:
        bouncing = replace(scene, surface=replace(surface, ground_damping=0.0))
        variants["damping of the ground"] = Variant(True, bouncing)
    if len(scene.dof) == 1:
        free = replace(scene, dof=("z", "pitch", "roll"))
        variants["pitch and roll"] = Variant(False, free)
    return variants


def _with_or_without(scene: Scene, axis: Any) -> Variant:
    carried = axis in scene.dof
    dof = (*scene.dof, axis)
    if carried:
        dof = tuple(a for a in scene.dof if a != axis)
    return Variant(carried, replace(scene, dof=dof))


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Change of a variant's frames from the scene's, beside the noise.

    `point`: scene, variant, n_steps (None: all), seed. Returns change_db, noise_db: 10
    log10(f_max^2 / mean squared difference) over the frames in contact; worst_db: of the frame that
    changes most; above_noise: share of the contact frames that change by more than the noise.
    """
    scene = SCENES[point["scene"]]()
    n_steps = point["n_steps"] or scene.n_steps
    scene = replace(scene, n_steps=min(n_steps, scene.n_steps))
    variant = variants(scene)[point["variant"]]
    noise_model = NoiseModel.for_range(scene.f_max_n)
    rng = np.random.default_rng(point["seed"])
    changes = []
    noises = []
    unchanged = Variant(True, scene)
    for ours, theirs in zip(unchanged.frames(), variant.frames(), strict=True):
        # A body that lands earlier touches in one of them alone.
        if any(in_contact(frame, scene.f_max_n) for frame in (ours, theirs)):
            noise = noise_model.apply(ours, rng) - ours
            changes.append(_mean_square(theirs - ours))
            noises.append(_mean_square(noise))
    above = [change > noise for change, noise in zip(changes, noises, strict=True)]
    return {
        "carried": variant.carried,
        "change_db": decibels(float(np.mean(changes)), scene.f_max_n),
        "noise_db": decibels(float(np.mean(noises)), scene.f_max_n),
        "worst_db": decibels(max(changes), scene.f_max_n),
        "above_noise": float(np.mean(above)),
    }


def _mean_square(difference: Floats) -> float:
    return float(np.mean(np.square(difference), dtype=np.float64))


def decibels(error: float, f_max_n: float) -> float:
    """PSNR of a mean squared difference in N^2, at most 100 dB."""
    # 100 dB is a part of 10^-10.
    lowest = f_max_n**2 * 1e-10
    return float(10.0 * np.log10(f_max_n**2 / max(error, lowest)))


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Every variant of every scene; quick: of three of them, as far as the first bounces."""
    common = {"n_steps": QUICK_STEPS if quick else None, "seed": seed}
    points = []
    for scene in QUICK_SCENES if quick else SCENES:
        for variant in variants(SCENES[scene]()):
            points.append(
                {
                    "scene": scene,
                    "variant": variant,
                    **common,
                }
            )
    return points


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute the study, write its page and return its conclusion; see `command.Study`."""
    computed = compute_rows(measure, points(quick, seed), out, executor, "scene needs")
    rows = pd.DataFrame(computed)
    rows["verdict"] = rows.apply(verdict, axis=1)
    page = Page(out, "scene-needs", Path(__file__).with_suffix(".md"), quick)
    page.section("", _draw(out, rows), summary(rows))
    parts: list[Any] = []
    for scene, of_scene in rows.groupby("scene", sort=False):
        parts += [f"**{scene}**", _table(of_scene)]
    page.section("Each scene", *parts)
    page.csv("scene-needs", rows)
    lines = conclusion(rows)
    page.write(lines)
    return lines


def verdict(row: Any) -> str:
    """Verdict on a variant by its figures."""
    matters = row["change_db"] < row["noise_db"] or row["above_noise"] > OFTEN
    if row["carried"]:
        if matters:
            return "needed"
        return "kept" if row["variant"] in KEPT else "superfluous"
    if not matters:
        return "rightly left out"
    return "left out" if (row["scene"], row["variant"]) in LEFT_OUT else "missing"


def conclusion(rows: pd.DataFrame) -> list[str]:
    """What the verdicts amount to."""
    n = rows["verdict"].value_counts()
    n_carried = int(rows["carried"].sum())
    needed = rows[rows["verdict"] == "needed"]["variant"]
    n_added = len(rows) - n_carried
    n_missing = n.get("missing", 0)
    return [
        f"Of {n_carried} terms that the scenes carry, {n.get('needed', 0)} change the frames by "
        f"more than the noise and are needed; {n.get('kept', 0)} are kept for a stated reason.",
        f"Of {n_added} that they do not carry, {n_added - n_missing} would change less than the "
        f"noise, or are left out for a stated reason; {n_missing} are missing.",
        f"Needed in some scene: {', '.join(sorted(set(needed))) or 'none'}.",
    ]


def summary(rows: pd.DataFrame) -> str:
    """Number of variants with each verdict, and names of those that should not be; as Markdown."""
    kinds = ("needed", "rightly left out", "kept", "left out", "superfluous", "missing")
    lines = [f"- {kind}: {(rows['verdict'] == kind).sum()}" for kind in kinds]
    # Those of the last two kinds contradict the scenes as they are.
    wrong = rows[rows["verdict"].isin(kinds[4:])]
    return "\n".join(lines + cells(wrong, "- **{verdict}**: {scene}: {variant}"))


def _table(rows: pd.DataFrame) -> pd.DataFrame:
    """Figures of one scene."""
    verdicts = []
    for row in rows.to_dict("records"):
        text = row["verdict"]
        if text == "kept":
            text += f": {KEPT[row['variant']]}"
        elif text == "left out":
            text += f": {LEFT_OUT[row['scene'], row['variant']]}"
        verdicts.append(text)
    return pd.DataFrame(
        {
            "variant": np.where(rows["carried"], "without ", "with ") + rows["variant"],
            "change, dB": cells(rows, "{change_db:.1f}"),
            "noise, dB": cells(rows, "{noise_db:.1f}"),
            "worst, dB": cells(rows, "{worst_db:.1f}"),
            "above": cells(rows, "{above_noise:.1%}"),
            "verdict": verdicts,
        }
    )


CHANGES_DB = (10.0, 105.0)
"""Ends of the axis of changes."""


def _draw(out: Path, rows: pd.DataFrame) -> str:
    scenes = list(rows["scene"].unique())
    names = list(rows["variant"].unique())[::-1]
    quantity = "Change of each scene's frames, in dB as PSNR"
    caption = f"{quantity}: the further left, the larger."
    size_in = (9.5, 3.2 * -(-len(scenes) // 3) + 1.1)
    chart = Chart(
        out,
        "scene-needs",
        caption,
        len(scenes),
        3,
        size_in=size_in,
        legend_columns=5,
    )
    with chart:
        for k, (axes, scene) in enumerate(zip(chart.panels, scenes, strict=True)):
            of_scene = rows[rows["scene"] == scene]
            _mark_noise(axes, of_scene["noise_db"].iloc[0], len(names))
            _draw_changes(axes, of_scene, names)
            axes.set(
                xlim=CHANGES_DB,
                ylim=(-0.6, len(names) + 0.9),
                title=scene,
            )
            axes.set_yticks(range(len(names)), [""] * len(names) if k % 3 else names)
        chart.figure.suptitle(
            "What a scene needs: its frames with one term removed or added, against its own\n"
            "(mark: mean of the contact frames; line: to the worst of them)",
            fontsize=10,
        )
        chart.label("change, dB (left: larger)", "")
    return chart.markdown


def _mark_noise(axes: Any, noise_db: float, n_names: int) -> None:
    """Shade the changes that are larger than the noise, and say what either side means."""
    shade = {
        "color": "#dddddd",
        "zorder": 0,
        "label": "above the noise",
    }
    axes.axvspan(CHANGES_DB[0], noise_db, **shade)
    style = {
        "ha": "center",
        "va": "top",
        "color": "0.3",
        "fontsize": 8,
    }
    texts = "above the noise:\nneeded", "below the noise:\ncan be left out"
    for edge, text in zip(CHANGES_DB, texts, strict=True):
        axes.text((edge + noise_db) / 2, n_names + 0.75, text, **style)


def _draw_changes(axes: Any, of_scene: pd.DataFrame, names: list[str]) -> None:
    """Draw the changes of a scene's variants: mean and worst frame of each."""
    for carried, colour, marker, label in (
        (True, PALETTE[0], "o", "removed"),
        (False, PALETTE[1], "s", "added"),
    ):
        of_kind = of_scene[of_scene["carried"] == carried]
        heights = [names.index(name) for name in of_kind["variant"]]
        changes = of_kind["change_db"]
        worst = of_kind["worst_db"]
        axes.hlines(heights, worst, changes, color=colour, lw=1.0)
        axes.plot(changes, heights, marker, color=colour, label=label)
        label_of_worst = f"{label}: worst frame"
        axes.plot(
            worst,
            heights,
            "|",
            color=colour,
            ms=9,
            label=label_of_worst,
        )
