"""The study `scene-needs`: the terms of each scene, removed or added one at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from sparseskin.nodes.sensor.scenes.scenes import SCENES
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import PALETTE, Chart, fill_page, write_csv

from .variants import measure, variants

Row = Mapping[str, Any]
QUICK_SCENES = ("lift_box_40", "lift_wrench_40", "path_40")
QUICK_STEPS = 1000
OFTEN = 0.05
"""Share of frames changed by more than their noise above which a scene is another one."""

#: Reasons for which a scene keeps what it does not need.
_KEPT = {
    "round taxels": "the skin is one and the same in all scenes",
    "damping of the ground": "the ground is one and the same in all scenes",
    "damping of the skin": "the skin is one and the same in all scenes",
    "moving average": "the recordings of the paper are smoothed; felt at the impact alone",
}
#: Reasons for which a scene does without what it would need.
_LEFT_OUT = {
    ("path_40", axis): "the peg is kept vertical, as in the paper"
    for axis in ("pitch", "roll", "pitch and roll")
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
    rows = compute_rows(measure, points(quick, seed), out, executor, "scene needs")
    rows = [{**row, "verdict": verdict(row)} for row in rows]
    frame = pd.DataFrame(rows)
    fill_page(
        out,
        "scene-needs",
        conclusion=conclusion(rows),
        quick=quick,
        quick_steps=QUICK_STEPS,
        chart=_chart(out, frame),
        summary=summary(rows, quick),
        scenes={
            scene: some.to_dict("records") for scene, some in frame.groupby("scene", sort=False)
        },
        reason=reason,
        csv=write_csv(out, "scene-needs", rows),
    )


def verdict(row: Row) -> str:
    """Verdict on a variant by its figures."""
    matters = row["change_db"] < row["noise_db"] or row["above_noise"] > OFTEN
    if row["carried"]:
        if matters:
            return "needed"
        return "kept" if row["variant"] in _KEPT else "superfluous"
    if not matters:
        return "rightly left out"
    return "left out" if (row["scene"], row["variant"]) in _LEFT_OUT else "missing"


def conclusion(rows: Sequence[Row]) -> list[str]:
    """What the verdicts amount to."""
    n = {kind: sum(row["verdict"] == kind for row in rows) for kind in ("needed", "kept")}
    n_carried = sum(bool(row["carried"]) for row in rows)
    n_added = len(rows) - n_carried
    n_missing = sum(row["verdict"] == "missing" for row in rows)
    needed = {row["variant"] for row in rows if row["verdict"] == "needed"}
    return [
        f"Of {n_carried} terms that the scenes carry, {n['needed']} change the frames by more than "
        f"the noise and are needed; {n['kept']} are kept for another reason, which is stated.",
        f"Of {n_added} that they do not carry, {n_added - n_missing} would change less than the "
        f"noise, or are left out for a stated reason; {n_missing} are missing.",
        f"Needed in some scene: {', '.join(sorted(needed)) or 'none'}.",
    ]


def summary(rows: Sequence[Row], quick: bool) -> str:
    """Number of variants with each verdict, and names of those that should not be; as Markdown."""
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


def reason(row: Row) -> str:
    """Reason for a verdict, where it needs one; for the table."""
    reasons = {
        "kept": _KEPT.get(row["variant"]),
        "left out": _LEFT_OUT.get((row["scene"], row["variant"])),
    }
    found = reasons.get(row["verdict"])
    return f": {found}" if found else ""


def _chart(out: Path, frame: pd.DataFrame) -> str:
    scenes = list(frame["scene"].unique())
    names = list(frame["variant"].unique())[::-1]
    chart = Chart(
        out,
        "scene-needs",
        "Change of each scene's frames, in dB as PSNR: the further left, the larger.",
        *(len(scenes), 3),
        size_in=(9.5, 3.2 * -(-len(scenes) // 3) + 1.1),
        legend_columns=5,
    )
    with chart:
        for k, (axes, scene) in enumerate(zip(chart.panels, scenes, strict=True)):
            mine = frame[frame["scene"] == scene]
            noise_db = mine["noise_db"].iloc[0]
            axes.axvspan(10.0, noise_db, color="#dddddd", zorder=0, label="above the noise")
            for place, text in (
                ((10.0 + noise_db) / 2, "above the noise:\nneeded"),
                ((noise_db + 105.0) / 2, "below the noise:\ncan be left out"),
            ):
                style: dict[str, Any] = {"ha": "center", "va": "top", "color": "0.3"}
                axes.text(place, len(names) + 0.75, text, fontsize=8, **style)
            for carried, colour, marker, label in (
                (True, PALETTE[0], "o", "removed"),
                (False, PALETTE[1], "s", "added"),
            ):
                some = mine[mine["carried"] == carried]
                heights = [names.index(name) for name in some["variant"]]
                changes, worst = some["change_db"], some["worst_db"]
                axes.hlines(heights, worst, changes, color=colour, lw=1.0)
                axes.plot(changes, heights, marker, color=colour, label=label)
                axes.plot(worst, heights, "|", color=colour, ms=9, label=f"{label}: worst frame")
            axes.set(xlim=(10.0, 105.0), ylim=(-0.6, len(names) + 0.9), title=scene)
            axes.set_yticks(range(len(names)), [""] * len(names) if k % 3 else names)
        chart.figure.suptitle(
            "What a scene needs: its frames with one term removed or added, against its own\n"
            "(mark: mean of the contact frames; line: to the worst of them)",
            fontsize=10,
        )
        chart.label("change, dB (left: larger)", "")
    return chart.markdown
