"""The study `scene-needs`: what each scene has to model, shown by taking it away or adding it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sparseskin.nodes.sensor.scenes import SCENES
from sparseskin.studies.points import compute
from sparseskin.studies.report import (
    PALETTE,
    chart_style,
    legend_outside,
    markdown_table,
    new_figure,
    save_figure,
    write_csv,
    write_page,
)
from sparseskin.studies.scene_needs_variants import measure, variants

Row = Mapping[str, Any]
QUICK_SCENES = ("lift_box_40", "lift_wrench_40", "path_40")
QUICK_STEPS = 1000
#: Changed by more than their noise in so many of its frames, a scene is another one.
OFTEN = 0.05

_TEXT = """# What a scene needs

Each scene is played beside itself with one degree of freedom or one term taken away, or with one
added that it does not have. *change*: 10 log10(f_max² / mean squared difference) of the two, over
the frames in which either is in contact; *noise*: the same of the skin's noise. A change of more
decibels than the noise is a smaller one: nobody who reads the skin could tell. *above*: share of
the contact frames that change by more than their noise; *worst*: the frame that changes most;
*time*: of the processor, for a frame. What changes a scene by more than the noise in the mean, or
in more than one frame of twenty, it needs; what does not, it should do without."""

#: Why a scene keeps what it does not need.
_KEPT = {
    "round taxels": "the skin is one and the same in all scenes",
    "damping of the ground": "the ground is one and the same in all scenes",
    "damping of the skin": "the skin is one and the same in all scenes",
    "moving average": "the recordings of the paper are smoothed; felt at the impact alone",
}
#: Why a scene does without what it would need.
_LEFT_OUT = {
    ("path_40", "pitch"): "the peg is kept vertical, as in the paper",
    ("path_40", "roll"): "the peg is kept vertical, as in the paper",
    ("path_40", "pitch and roll"): "the peg is kept vertical, as in the paper",
}


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Every variant of every scene; quick: of three of them, as far as the first bounces."""
    n_steps = QUICK_STEPS if quick else None
    return [
        {"scene": scene, "variant": variant, "n_steps": n_steps, "seed": seed}
        for scene in (QUICK_SCENES if quick else SCENES)
        for variant in variants(SCENES[scene]())
    ]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute what is not known yet, and write chart, tables and the page `scene-needs.md`."""
    asked = points(quick, seed)
    figures = compute(measure, asked, out, executor, "scene needs")
    rows = [{**point, **figure} for point, figure in zip(asked, figures, strict=True)]
    rows = [{**row, "verdict": verdict(row)} for row in rows]
    parts = [_TEXT]
    if quick:
        parts.append(_quick_text())
    parts += [_chart(out, rows), summary(rows, quick)]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        parts += [f"## {scene}", _table([row for row in rows if row["scene"] == scene])]
    parts.append(f"All figures: {write_csv(out, 'scene-needs', rows)}.")
    write_page(out, "scene-needs", parts)


def verdict(row: Row) -> str:
    """What follows from a variant's figures."""
    matters = row["change_db"] < row["noise_db"] or row["above_noise"] > OFTEN
    if row["carried"]:
        if matters:
            return "needed"
        return "kept" if row["variant"] in _KEPT else "superfluous"
    if not matters:
        return "rightly left out"
    return "left out" if (row["scene"], row["variant"]) in _LEFT_OUT else "missing"


def _quick_text() -> str:
    return (
        f"Quick: {len(QUICK_SCENES)} scenes, their first {QUICK_STEPS} steps. That is the impact, "
        "the bounces after it and little else, so a verdict here may differ from that of the whole "
        "scene, where they are a small share of the frames in contact: the run without --quick "
        "decides."
    )


def summary(rows: Sequence[Row], quick: bool) -> str:
    """How many variants have each verdict, and by name those that should not be; as Markdown."""
    counts = {
        kind: [f"{row['scene']}: {row['variant']}" for row in rows if row["verdict"] == kind]
        for kind in ("needed", "rightly left out", "kept", "left out", "superfluous", "missing")
    }
    lines = [f"- {kind}: {len(found)}" for kind, found in counts.items()]
    for kind in ("superfluous", "missing"):
        shortened = f" (of its first {QUICK_STEPS} steps alone)" if quick else ""
        lines += [f"- **{kind}**: {name}{shortened}" for name in counts[kind]]
    if not counts["superfluous"] + counts["missing"]:
        lines.append(
            "- So each scene carries what changes its frames above the noise, and else only what "
            "is the same in all scenes."
        )
    return "\n".join(lines)


def _table(rows: Sequence[Row]) -> str:
    lines = []
    for row in rows:
        name, kind = row["variant"], row["verdict"]
        why = {"kept": _KEPT.get(name, ""), "left out": _LEFT_OUT.get((row["scene"], name), "")}
        cost = 100.0 * (row["variant_us"] / row["scene_us"] - 1.0)
        lines.append(
            [
                ("without " if row["carried"] else "with ") + name,
                f"{row['change_db']:.1f}",
                f"{row['noise_db']:.1f}",
                f"{row['worst_db']:.1f}",
                f"{100 * row['above_noise']:.1f} %",
                f"{cost:+.0f} %",
                kind + (f": {why[kind]}" if why.get(kind) else ""),
            ]
        )
    header = ["variant", "change, dB", "noise, dB", "worst, dB", "above", "time", "verdict"]
    return markdown_table(header, lines)


def _chart(out: Path, rows: Sequence[Row]) -> str:
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    names = list(dict.fromkeys(row["variant"] for row in rows))[::-1]
    n_rows = -(-len(scenes) // 3)
    with chart_style():
        figure = new_figure(9.5, 2.9 * n_rows + 0.6)
        for k, scene in enumerate(scenes):
            axes = figure.add_subplot(n_rows, 3, k + 1)
            mine = [row for row in rows if row["scene"] == scene]
            noise_db = mine[0]["noise_db"]
            axes.axvspan(10.0, noise_db, color="#dddddd", zorder=0, label="above the noise")
            for carried, colour, marker, label in (
                (True, PALETTE[0], "o", "taken away"),
                (False, PALETTE[1], "s", "added"),
            ):
                some = [row for row in mine if row["carried"] == carried]
                heights = [names.index(row["variant"]) for row in some]
                changes = [row["change_db"] for row in some]
                worst = [row["worst_db"] for row in some]
                axes.hlines(heights, worst, changes, color=colour, lw=1.0)
                axes.plot(changes, heights, marker, color=colour, label=label)
                axes.plot(worst, heights, "|", color=colour, ms=9, label=f"{label}: worst frame")
            axes.set(xlim=(10.0, 105.0), ylim=(-0.6, len(names) - 0.4), title=scene)
            axes.set_yticks(range(len(names)), names if k % 3 == 0 else [""] * len(names))
            if k + 3 >= len(scenes):
                axes.set_xlabel("change of the frames, dB")
        legend_outside(figure, n_columns=5)
        return save_figure(
            figure,
            out,
            "scene-needs",
            "Change of each scene's frames, in dB as PSNR: the further left, the larger.",
        )
