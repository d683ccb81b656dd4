"""`sparseskin study endurance`: the solver "skin" over a million frames, never reset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .endurance_points import LOST, PER_ROUND, SCENES, endured
from .points import compute
from .report import markdown_table, write_csv, write_page

#: Rows and columns, N / M, rows of the measurement matrix.
STREAMS = ((20, 3, "fixed"), (20, 3, "rotating"), (20, 8, "rotating"))
#: Of which an eighth is lost.
LONG_FRAMES, QUICK_FRAMES = 1_150_000, 2 * PER_ROUND
ALLOWED_DB = 1.0
_INTRODUCTION = f"""\
# Endurance

One solver "skin" with its defaults restores {SCENES} random scenes over and over, each time with
other noise, and is never reset. From one scene to the next everything changes between two frames;
in every fourth scene {LOST} frames are lost. The third frame after each of these is set beside
that of a solver that starts there with the same frames: a solver that locked in to what it had
would be far behind it. How far two such solvers are apart, which differ in the shifts they draw
alone, stands in the last column but one: no solver can be nearer to another than that. (Above 60
dB, where the error is a sixth of the noise, all count as equal.) Every round has the same scenes,
so that a solver that drifts would show in its mean PSNR."""


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the study and write its page.

    Parameters
    ----------
    out : Path
        Folder for the page and its table.
    quick : bool
        Two rounds a stream, not a million frames.
    seed : int
        Seed of noise and Phi.
    executor : str
        Where points are computed.

    Raises
    ------
    StudyError
        If a point fails.
    """
    points = [
        {
            "side": side,
            "ratio": ratio,
            "rows": rows,
            "n_frames": QUICK_FRAMES if quick else LONG_FRAMES,
            "seed": seed,
        }
        for side, ratio, rows in STREAMS
    ]
    found = compute(endured, points, out, executor, "streams")
    rows = [summary(point, figures) for point, figures in zip(points, found, strict=True)]
    table = markdown_table(list(rows[0]), [list(row.values()) for row in rows])
    write_page(out, "endurance", [_INTRODUCTION, table, write_csv(out, "endurance", rows)])


def summary(point: dict[str, Any], figures: dict[str, Any]) -> dict[str, str]:
    """One line of the table, by column."""
    rounds = figures["rounds_db"]
    return {
        "taxels": str(point["side"] ** 2),
        "M": f"N/{point['ratio']}, {point['rows']}",
        "frames": f"{figures['n_frames']:,}",
        "not finite": str(figures["not_finite"]),
        "largest force, N": f"{figures['largest_n']:.2f}",
        "first round, dB": f"{rounds[0]:.2f}",
        "last round, dB": f"{rounds[-1]:.2f}",
        "least round, dB": f"{min(rounds):.2f}",
        f"after a jump within {ALLOWED_DB:g} dB of a cold start": _within(figures["jumps_db"]),
        f"after {LOST} lost frames": _within(figures["losses_db"]),
        f"two cold starts within {ALLOWED_DB:g} dB": _within(figures["apart_db"]),
        "ms a frame": f"{figures['frame_ms']:.2f}",
    }


def _within(behind_db: list[float]) -> str:
    behind = np.array(behind_db)
    if not behind.size:
        return "none"
    return (
        f"{100 * float(np.mean(behind <= ALLOWED_DB)):.1f} % of {behind.size:,} "
        f"(median {float(np.median(behind)):+.1f} dB, worst {float(behind.max()):+.1f} dB)"
    )
